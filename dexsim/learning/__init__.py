"""Learning: PPO from rsl-rl on a dexsim environment, checkpoints, and the gymnasium view of the same environment."""
