import gymnasium
import magex

if __name__ == "__main__":
    magex.serve(lambda: gymnasium.make("CartPole-v1"))
