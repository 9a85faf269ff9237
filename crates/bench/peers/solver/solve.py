"""Seconds of scipy's linear_sum_assignment on one problem, the least of several runs, and its cost.

Arguments: points or matrix, rows, columns, runs. Standard input: doubles, little endian: agents [rows, 2] and goals
[columns, 2], or costs [rows, columns]. The matrix of distances is made before the clock starts.
"""

import sys
import time

import numpy
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

kind, rows, cols, runs = sys.argv[1], *map(int, sys.argv[2:5])
data = numpy.frombuffer(sys.stdin.buffer.read(), dtype="<f8")
if kind == "points":
    points = data.reshape(-1, 2)
    cost = cdist(points[:rows], points[rows:])
else:
    cost = data.reshape(rows, cols)
best = float("inf")
for _ in range(runs):
    start = time.perf_counter()
    chosen = linear_sum_assignment(cost)
    best = min(best, time.perf_counter() - start)
print(best, repr(float(cost[chosen].sum())))
