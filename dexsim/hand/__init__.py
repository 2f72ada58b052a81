"""A hand is a folder: a model (MJCF or URDF) and `hand.yaml`, which says what no model file says: fingers and their
tips, the order of joints on the wire, the palm's frame, poses, the servo table, the touch pads.

`load_hand("xhand")` or `load_hand("path/to/folder")`; the format: docs/reference/hand.md, `dexsim.hand.schema`.
"""

from dexsim.hand.hand import Finger, Hand
from dexsim.hand.load import HANDS, load_hand

__all__ = ["HANDS", "Finger", "Hand", "load_hand"]
