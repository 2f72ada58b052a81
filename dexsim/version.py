"""The version of dexsim, which the wheel takes from here, and those of packages."""

from importlib import metadata

VERSION = "0.2.0"


def installed(*packages: str) -> dict[str, str]:
    """Return the version of each package that is installed."""
    found = dict.fromkeys(packages, "not installed")
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
