"""What pyproject.toml cannot say: the wheel packs checkpoints/*.pt as dexsim/policies."""

from setuptools import find_namespace_packages, setup

setup(
    packages=[*find_namespace_packages(include=["dexsim*"]), "dexsim.policies"],
    package_dir={"dexsim.policies": "checkpoints"},
)
