"""dexsim: train, feel and diagnose dexterous hands on MuJoCo-Warp."""

__version__ = "0.1.0"
