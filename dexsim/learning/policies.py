"""Policies by name: those that come with dexsim (`grasp`), and those of a Hugging Face repository
(`hub:OWNER/REPOSITORY`)."""

from __future__ import annotations

from pathlib import Path

from dexsim import files
from dexsim.errors import UserError
from dexsim.paths import POLICIES

HUB = "hub:"
FORM = "hub:OWNER/REPOSITORY[/FILE.pt][@REVISION]"


def included() -> list[str]:
    """Names of the policies that come with dexsim."""
    return sorted(path.stem for path in POLICIES.glob("*.pt"))


def place(name: str | Path) -> Path:
    """Return the file of a policy: a path, the name of one that comes with dexsim where no such file is here, or
    `hub:OWNER/REPOSITORY`, which is fetched once and then read from Hugging Face's cache.

    Raises UserError for a name of another form, without the extra `hub`, and for what the server refuses."""
    text = str(name)
    if text.startswith(HUB):
        return _fetched(text)
    path = files.place(name)
    return POLICIES / f"{text}.pt" if text in included() and not path.exists() else path


def _fetched(text: str) -> Path:
    path, _, revision = text.removeprefix(HUB).partition("@")
    parts = path.split("/")
    if len(parts) < 2 or not all(parts):
        raise UserError(f"checkpoint={text}: a policy on Hugging Face is {FORM}")
    try:
        from huggingface_hub import hf_hub_download
        from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError
    except ImportError:
        raise UserError(f"checkpoint={text}: fetching it needs a package: pip install 'dexsim[hub]'") from None
    file = "/".join(parts[2:]) or "policy.pt"
    try:
        return Path(hf_hub_download("/".join(parts[:2]), file, revision=revision or None))
    except LocalEntryNotFoundError as error:
        reason = f"the server cannot be reached, and it was not fetched before ({_line(error.__cause__ or error)})"
    except HFValidationError as error:
        reason = f"{_line(error)}; its form is {FORM}"
    except (HfHubHTTPError, OSError) as error:
        reason = f"{file} of revision {revision or 'main'} cannot be fetched ({_line(error)})"
    raise UserError(f"checkpoint={text}: {reason}")


def _line(error: BaseException) -> str:
    return next((line.strip()[:200] for line in str(error).splitlines() if line.strip()), type(error).__name__)
