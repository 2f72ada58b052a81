"""`python tools/debian.py ROOT [TORCH=cpu] [dexsim's arguments ...]`: build the Dockerfile's image as a folder, with
debootstrap and chroot instead of Docker, and run dexsim in it (its CMD, where none is given).

ROOT must not exist; what is in it afterwards is the image. Needs root and debootstrap. PIP_FIND_LINKS, where it is set,
is also looked through for wheels: without it torch's CPU build comes from PyTorch's index.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import string
import subprocess
import sys
from pathlib import Path

CERTIFICATES = "/etc/ssl/certs/ca-certificates.crt"
SOURCE = Path(__file__).resolve().parents[1]


def steps(text: str) -> list[tuple[str, str]]:
    """Return (INSTRUCTION, the rest) of each line of a Dockerfile."""
    lines = re.sub(r"\\\n\s*", " ", text).splitlines()
    return [(w[0], w[1]) for line in lines if line and not line.startswith("#") for w in [line.split(" ", 1)]]


def inside(root: Path, folder: str, env: dict[str, str], command: list[str]) -> None:
    """Run a command in the image, from a folder of it. Raises CalledProcessError."""
    words = ["chroot", str(root), "/usr/bin/env", "-i", *(f"{k}={v}" for k, v in env.items()), "/bin/sh", "-c",
             'cd "$0" && exec "$@"', folder, *command]  # fmt: skip
    subprocess.run(words, check=True)


def main(argv: list[str]) -> int:
    if not argv or argv[0].startswith("-") or Path(argv[0]).exists():
        print(__doc__)
        return 2
    root, given = Path(argv[0]).resolve(), dict(a.split("=", 1) for a in argv[1:2] if a.startswith("TORCH="))
    env = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root",
           "DEBIAN_FRONTEND": "noninteractive"}  # fmt: skip
    folder, entry, command = "/", [], []
    links = os.environ.get("PIP_FIND_LINKS", "")
    try:
        for word, rest in steps((SOURCE / "Dockerfile").read_text("utf-8")):
            print(f"== {word} {rest}", flush=True)
            if word == "FROM":
                release = re.fullmatch(r"debian:(\w+)-slim", rest)[1]
                subprocess.run(["debootstrap", "--variant=minbase", release, root], check=True,
                               stdout=subprocess.DEVNULL)  # fmt: skip
                shutil.copy("/etc/resolv.conf", root / "etc")
                if Path(CERTIFICATES).is_file():  # whom this machine trusts: it may stand behind a proxy
                    shutil.copy(CERTIFICATES, root / "host.crt")
                    env |= {"PIP_CERT": "/host.crt", "SSL_CERT_FILE": "/host.crt"}
                for place in ("proc", "dev"):
                    subprocess.run(["mount", "--rbind", f"/{place}", root / place], check=True)
                if links:
                    (root / "wheels").mkdir()
                    for path in Path(links).glob("torch-*.whl"):
                        shutil.copy(path, root / "wheels")
                    env["PIP_FIND_LINKS"] = "/wheels"
            elif word == "ARG":
                name, _, value = rest.partition("=")
                env[name] = given.get(name, value)
            elif word == "ENV":
                name, _, value = rest.partition("=")
                env[name] = string.Template(value).substitute(env)
            elif word == "WORKDIR":
                folder = rest
                (root / folder[1:]).mkdir(parents=True, exist_ok=True)
            elif word == "COPY":
                *names, to = rest.split()
                for name in names:
                    target = root / folder[1:] / to
                    if (SOURCE / name).is_dir():
                        shutil.copytree(SOURCE / name, target, ignore=shutil.ignore_patterns("__pycache__"))
                    else:
                        shutil.copy(SOURCE / name, target)
            elif word == "RUN":
                if links and "download.pytorch.org" in rest:  # the wheel is here already
                    rest = re.sub(r" --index-url [^\s;]+", " --no-index --find-links /wheels", rest)
                inside(root, folder, env, ["/bin/sh", "-c", rest])
            elif word in ("ENTRYPOINT", "CMD"):
                entry, command = (json.loads(rest), command) if word == "ENTRYPOINT" else (entry, json.loads(rest))
            else:
                raise ValueError(f"Dockerfile: {word} is not known here")
        inside(root, folder, env, [*entry, *(argv[1 + len(given):] or command)])
    finally:
        for place in ("proc", "dev"):
            subprocess.run(["umount", "-lR", root / place], stderr=subprocess.DEVNULL)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
