"""`dexsim import-hand model.urdf out=hands/mine`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dexsim import typed, yaml_text
from dexsim.errors import UserError

USAGE = """usage: dexsim import-hand MODEL out=FOLDER [key=value ...]  MODEL: URDF or MJCF file, or menagerie:NAME
       dexsim import-hand check FOLDER [key=value ...]
       dexsim import-hand skin FOLDER skin=LINK:TAXELS,... [out=FOLDER2]

Make a hand of a robot's file: find its palm, fingers and tips, guess the palm's frame, an open and a cupped pose, give
it collision shapes and touch pads, and write a folder that every task takes: dexsim train task=grasp hand=FOLDER

  FOLDER/hand.yaml      what no model file says, every guess marked: correct it, run the same command again
  FOLDER/model.xml      the hand with its collision shapes; meshes/
  FOLDER/servo.yaml     its drives, from efforts and speeds
  FOLDER/taxels_*.csv   its touch pads; skin_*.obj: the surfaces that carry them
  FOLDER/picture.png    the hand, frames, joint names, open and cupped, shapes, pads

A second run keeps what you corrected in hand.yaml and every file that you changed. `check` moves each joint in turn,
says what it does, and shows it: FOLDER/check.png (film=true: check.mp4 too).

settings (key=default):
  name=             of the hand (default: the model's file name)
  palm=             body to take for the palm (default: the last one that all fingers share)
  pads=8x6          taxels of a fingertip, rows (along the finger) x columns; pads=none; pads=FILE.csv with columns
                    finger,x,y,z,nx,ny,nz (m, in the tip body's frame)
  skin=             touch on further links, e.g. palm:80/4,links:20 (dexsim import-hand skin says more)
  effort= speed=    N m and rad/s of the joints for which the file says none
  density=          kg/m3 of links without an inertia
  inertia=          of links whose moments no body has: shapes (those of its shapes) or balance (the mean of the three)
  coupled=keep      joints tied by tendons, mimic or equality follow as the file says; independent: a motor for each
  holes=hull        of a fingertip's mesh with a hole the convex hull is taken, or refuse
  packages=         folders in which package:// is looked for, separated by commas
  drops=256         objects let fall, to find where the hand holds them; 0: told from its cupped pose alone
  picture=true      false: do not render
  PLACE=VALUE       any place of hand.yaml, e.g. palm.normal=[0,0,1] poses.cupped.j1=0.8 fingers.thumb.closes=[1,-1]
"""
MOST_DROPS = 100_000
OPTIONS = {"coupled": ("keep", "independent"), "holes": ("hull", "refuse"), "inertia": ("shapes", "balance")}
NUMBERS = {"effort": (0.001, 100.0, "N m"), "speed": (0.01, 200.0, "rad/s"), "density": (1.0, 3e4, "kg/m3")}
KEYS = ("out", "name", "palm", "pads", "skin", *OPTIONS, *NUMBERS, "drops", "packages", "picture")
PLACES = ("palm.", "poses.", "fingers.", "joints.", "places.", "opposing", "handedness", "span", "force")


def main(argv: Sequence[str]) -> int:
    """Run the command; return the exit status. Raises UserError."""
    if argv[0] == "check":
        from dexsim.import_hand import moves

        return moves.main(argv[1:])
    if argv[0] == "skin":
        from dexsim.import_hand import skin

        return skin.main(list(argv[1:]))
    model, given, said = arguments(argv)
    if "out" not in given:
        raise UserError("say where to write: out=FOLDER, e.g. out=hands/mine")
    from dexsim.import_hand import known
    from dexsim.import_hand.importing import import_hand

    out = Path(given["out"]).expanduser()
    result = import_hand(
        known.model(model), out, settings(given, said), say=lambda text: print(text, flush=True),
        picture=typed.truth("picture", given.get("picture", "true")),
    )  # fmt: skip
    if result.corrected:
        print(f"kept     your corrections: {', '.join(result.corrected)}")
    for name in result.carried:
        print(f"kept     {name}, which you changed or added (delete it to have it written anew)")
    print(
        f"\n{out}/hand.yaml holds {len(result.hand['guessed'])} guesses. Look at {out}/picture.png, correct hand.yaml,"
        " run this again."
    )
    print(f"Then: dexsim import-hand check {out}, and dexsim train hand={out}")
    return 0


def arguments(argv: Sequence[str]) -> tuple[str, dict[str, str], dict[str, Any]]:
    """Return the model's file, settings, and places of hand.yaml with their values."""
    models, given = typed.words(argv, KEYS, PLACES)
    if len(models) != 1:
        raise UserError(
            f"one model file is needed, {len(models)} given{': ' + ', '.join(models) if models else ''}:"
            " dexsim import-hand model.urdf out=hands/mine"
        )
    said = {key: yaml_text.parse(given.pop(key), key) for key in list(given) if key not in KEYS}
    return models[0], given, said


def settings(given: dict[str, str], said: dict[str, Any]) -> Any:
    """Return the settings as `dexsim.import_hand.importing.Settings`."""
    from dexsim.import_hand.importing import Settings

    own: dict[str, Any] = {key: given[key] for key in ("palm", "name", "skin") if given.get(key)}
    own |= {key: typed.one_of(key, given[key], allowed) for key, allowed in OPTIONS.items() if key in given}
    own |= {key: typed.number(key, given[key], *limits) for key, limits in NUMBERS.items() if given.get(key)}
    out = Settings(said=said, **own)
    if given.get("drops"):
        out.drops = typed.whole("drops", given["drops"], 0, MOST_DROPS)
    if given.get("packages"):
        out.packages = [Path(p.strip()).expanduser() for p in given["packages"].split(",")]
        for p in out.packages:
            if not p.is_dir():
                raise UserError(f"packages={p}: no such folder")
    pads = given.get("pads", "8x6")
    if pads == "none":
        out.pads = None
    elif pads.endswith(".csv"):
        out.pads = Path(pads).expanduser()
    else:
        rows, x, columns = pads.partition("x")
        if not (x and rows.isdecimal() and columns.isdecimal() and 1 <= int(rows) <= 40 and 1 <= int(columns) <= 40):
            raise UserError(f"pads={pads}: must be ROWSxCOLUMNS (1 to 40 each, e.g. 8x6), none, or a .csv file")
        out.pads = (int(rows), int(columns))
    return out
