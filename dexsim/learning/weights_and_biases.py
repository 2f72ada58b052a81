"""Weights & Biases beside TensorBoard, by rsl-rl's own writer: `agent.logger=wandb agent.wandb_project=NAME`."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

from dexsim.errors import UserError


class _Settings:
    """A mapping as rsl-rl's writer wants it: it asks for `to_dict`."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.to_dict = lambda: values


def check_installed() -> None:
    """Check that wandb, which is no dependency of dexsim, is installed. Raises UserError where it is missing."""
    spec = importlib.util.find_spec("wandb")
    # a folder wandb/, which its runs leave, is found as a package without a file
    if spec is None or spec.origin is None:
        raise UserError(
            "agent.logger=wandb: Weights & Biases is not installed here; pip install wandb, then wandb login"
        )


def open_writer(logger: Any, folder: Path, project: str, config: dict[str, Any]) -> None:
    """Start a run of Weights & Biases.

    Args:
        logger: rsl-rl's `Logger`; its writer is set.
        folder: the run's, which also names the run; what is kept of it locally goes there unless WANDB_DIR says
        otherwise.
        config: the resolved settings, shown with the run.

    Raises:
        UserError: not installed, not logged in, or no connection.
    """
    check_installed()
    import wandb

    os.environ.setdefault("WANDB_DIR", str(folder))
    logger.cfg["logger"] = {"class_name": "WandbLogWriter", "project_name": project}
    logger.env_cfg = _Settings(config)
    try:
        logger.init_logging_writer()
    except wandb.Error as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        raise UserError(
            f"agent.logger=wandb: {lines[0]} (wandb login; or WANDB_MODE=offline, and wandb sync later)"
        ) from error
