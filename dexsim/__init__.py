"""dexsim: train, feel and diagnose dexterous hands on MuJoCo-Warp."""

from dexsim.version import VERSION as __version__

__all__ = ["__version__"]
