"""train.py with view=true: a page that follows the run, served by a process of its own on the CPU.

The training itself waits for nothing: the other process plays the policies that the run saves (`dexsim play view=true`)
and reads its progress.csv. It ends with the training, however that ends (`view_while`).
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from dexsim.tasks.registry import typing
from dexsim.view.live_gate import check_free

LOG = "view.log"
WORLDS = 4


class Watch:
    """The page of one run. cfg: the run's settings; where: its folder. Raises UserError where nothing can be served."""

    def __init__(self, cfg: dict[str, Any], where: Path):
        self._cfg, self._where = cfg, where
        self._process: subprocess.Popen | None = None
        check_free("127.0.0.1", cfg["view_port"])

    def begin(self) -> None:
        """Serve, once there is a policy; called again, nothing."""
        if self._process is not None:
            return
        port, log = self._cfg["view_port"], self._where / LOG
        task = typing(str(self._cfg["task"]["class"])).split() if "class" in self._cfg["task"] else []
        command = [sys.executable, "-m", "dexsim", "play", f"checkpoint={self._where / 'policy.pt'}", "view=true",
                   "device=cpu", f"worlds={WORLDS}", "sim.threads=1", f"view_port={port}", f"view_while={os.getpid()}",
                   f"out={self._where / 'view'}", *task]  # fmt: skip
        env = os.environ | {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
        with log.open("w", encoding="utf-8") as out:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=env, start_new_session=True
            )
        print(
            f"view     http://localhost:{port} (in a moment; what it says: {log}; from another machine first ssh -L"
            f" {port}:localhost:{port} THIS_MACHINE)",
            flush=True,
        )

    def end(self) -> None:
        """Serve no longer."""
        if self._process is not None:
            self._process.terminate()
