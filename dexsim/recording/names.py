"""Joint names of a recording matched once with the model's, whatever prefix a driver puts before them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from dexsim.errors import UserError


def match(theirs: Sequence[str], ours: Sequence[str], given: Mapping[str, str], where: str) -> dict[str, str]:
    """Their name -> ours, for those that can be matched.

    A name fits when it is equal, or equal but for case and separators, or when one ends with the other
    (`right_hand_index_joint1`, `index_joint1`); the longest fit wins. given: our name -> theirs, as stated by the user.
    Raises UserError where two of theirs fit one of ours, or a given name does not exist.
    """
    for our, their in given.items():
        if their not in theirs:
            raise UserError(f"{where}: remap.{our}={their}: the recording has no joint '{their}'; it has: {', '.join(theirs)}")
        if our not in ours:
            raise UserError(f"{where}: remap.{our}={their}: no joint is called '{our}'; there are: {', '.join(ours)}")
    out = {their: our for our, their in given.items()}
    claims: dict[str, list[str]] = {}
    for their in theirs:
        if their in out:
            continue
        fits = [our for our in ours if our not in given and _fits(_plain(their), _plain(our))]
        if fits:
            exact = [our for our in fits if our == their]
            claims.setdefault(exact[0] if exact else max(fits, key=len), []).append(their)
    for our, claimants in claims.items():
        exact = [c for c in claimants if c == our]
        best = exact or claimants
        if len(best) > 1 and not _side(our):  # both hands in one file: the model's names do not say which; take the right
            best = [c for c in best if _side(c) == "right"] or best
        if len(best) > 1:
            raise UserError(f"{where}: {' and '.join(best)} could both be joint '{our}'; say which with remap.{our}=NAME")
        out[best[0]] = our
    return out


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _fits(a: str, b: str) -> bool:
    return a == b or a.endswith("_" + b) or b.endswith("_" + a)


def _side(name: str) -> str:
    words = _plain(name).split("_")
    return next((side for side, short in (("left", "l"), ("right", "r")) if side in words or words[0] == short), "")
