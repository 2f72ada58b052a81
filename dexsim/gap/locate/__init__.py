"""Step 2: where and in which regime simulation and recording part."""
