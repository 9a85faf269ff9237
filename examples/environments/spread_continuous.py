import magex
from mpe2 import simple_spread_v3

if __name__ == "__main__":
    magex.serve(lambda: simple_spread_v3.parallel_env(continuous_actions=True))
