"""Physics: N worlds of one compiled model behind one small interface.

`make_engine` picks MuJoCo-Warp (CUDA) or C MuJoCo (CPU). Everything above this package sees `Engine` only: neither
graphs, nor contact buffers, nor which engine runs.
"""

from __future__ import annotations

from dexsim.sim.engine import ContactPair, Engine
from dexsim.sim.make import make_engine

__all__ = ["ContactPair", "Engine", "make_engine"]
