"""A trained policy outside the simulator: observations, limits, the real-time loop and its drivers."""
