# Three walkers carry a package; four joints each, in real numbers. pip install -r requirements-walkers.txt
import magex
from pettingzoo.sisl import multiwalker_v9

if __name__ == "__main__":
    # Its state() raises in the step in which a walker falls.
    magex.serve(multiwalker_v9.parallel_env, state=False)
