"""Touch: taxels that feel objects by signed distance.

Stated once, for all of dexsim:

- A taxel's force is what the FINGER EXERTS ON THE OBJECT, in the taxel's own frame: +z out of the pad along the
  taxel's own normal, so compression is fz >= 0 (as on the wire); fx and fy act in the taxel's tangent plane, y along
  the sensor's y axis projected on it (towards the fingertip), x = y x z: across the pad, around the finger.
- Index of a taxel in its pad: k = column * 12 + row; columns 0..9 across the pad (column 0 at the -x edge of the thumb,
  the -y edge of a finger, in the frame of the distal link), rows 0..11 from proximal to distal. Other mechanisms bring
  another layout; nothing here assumes a count of pads or taxels.
- Fingers (pads) are in the order of the layout: thumb, index, mid, ring, pinky for the xHand.
- Positions are in the world frame, which is the palm frame in every scene of dexsim.
- Signed distances are negative inside an object. Depth = -distance where that is positive.
- Units: m, N, s.
"""

from dexsim.tactile.layout import TaxelLayout, hand_layout, load_layout, tip_layout, tip_points
from dexsim.tactile.shapes import ShapeSet
from dexsim.tactile.tactile import Tactile

__all__ = [
    "ShapeSet", "Tactile", "TaxelLayout", "hand_layout", "load_layout", "tip_layout", "tip_points",
]  # fmt: skip
