"""`dexsim tasks`: the tasks that can be chosen by name, a line each."""

from __future__ import annotations

from dexsim.console.tables import table
from dexsim.errors import UserError
from dexsim.tasks import registry

USAGE = """usage: dexsim tasks

List the tasks: those of dexsim, and those of installed packages (entry points of the group dexsim.tasks). Any other
class is named in full, task=module:Class; the current folder is looked in too.
"""


def main(argv: list[str]) -> int:
    """Print the table; returns 0."""
    if argv:
        raise UserError(f"{argv[0]}: dexsim tasks takes no settings")
    rows = []
    for entry in registry.entries():
        try:
            about = ((registry.load(entry.where).__doc__ or "").strip().splitlines() or [""])[0]
        except UserError as error:  # a package that is broken hides none of the others
            about = f"({error})"
        rows.append((entry.name, entry.where, entry.origin, about))
    print(table("tasks", ("task=", "class", "from", "what"), rows))
    print("\nor a class of your own: dexsim train task=module:Class")
    return 0
