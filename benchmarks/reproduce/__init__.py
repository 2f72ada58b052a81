"""The paper's two ablation tables, trained and judged again: `python -m benchmarks.reproduce table=rotation|grasp`."""
