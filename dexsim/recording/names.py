"""Joint names of a recording matched once with the model's, whatever prefix a driver puts before them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from dexsim.errors import UserError


def match(
    theirs: Sequence[str], ours: Sequence[str], given: Mapping[str, str], where: str, shorter: bool = True
) -> dict[str, str]:
    """Return their name -> ours, for those that can be matched.

    A name fits when it is equal, or equal but for case and separators, or when theirs ends with ours
    (`right_hand_index_joint1`, `index_joint1`; the longest fit wins), or (`shorter`) when the only one of ours that
    ends with theirs is meant. given: our name -> theirs, as stated by the user.
    Raises UserError where two of theirs fit one of ours, or a given name does not exist.
    """
    for our, their in given.items():
        if their not in theirs:
            raise UserError(
                f"{where}: remap.{our}={their}: the recording has no joint '{their}'; it has: {', '.join(theirs)}"
            )
        if our not in ours:
            raise UserError(f"{where}: remap.{our}={their}: no joint is called '{our}'; there are: {', '.join(ours)}")
    out = {their: our for our, their in given.items()}
    # a name that says more is settled first: what it takes is not free for a shorter one
    for rule in (
        lambda a, b: a == b,
        lambda a, b: a.endswith("_" + b),
        *([lambda a, b: b.endswith("_" + a)] if shorter else []),
    ):
        free = [our for our in ours if our not in out.values()]
        claims: dict[str, list[str]] = {}
        for their in (t for t in theirs if t not in out):
            fits = [our for our in free if rule(_plain(their), _plain(our))]
            longest = max((len(our) for our in fits), default=0)
            best = [our for our in fits if len(our) == longest]
            if len(best) == 1 and (len(fits) == 1 or len(_plain(best[0])) < len(_plain(their))):
                claims.setdefault(best[0], []).append(their)
        for our, claimants in claims.items():
            if len(claimants) > 1 and not _side(
                our
            ):  # both hands in one file: the model's names do not say which; take the right
                claimants = [c for c in claimants if _side(c) == "right"] or claimants
            if len(claimants) > 1:
                raise UserError(
                    f"{where}: {' and '.join(claimants)} could both be joint '{our}'; say which with remap.{our}=NAME"
                )
            out[claimants[0]] = our
    return out


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _side(name: str) -> str:
    words = _plain(name).split("_")
    return next((side for side, short in (("left", "l"), ("right", "r")) if side in words or words[0] == short), "")
