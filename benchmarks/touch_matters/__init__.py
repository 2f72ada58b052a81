"""When touch matters: rows of sensors, trained and judged on the task by fingertips alone."""
