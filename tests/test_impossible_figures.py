"""Figures that no machine has, in metadata and models: one line that names them, instead of an answer fitted around
them."""

from __future__ import annotations

import pytest
import recordings

from dexsim.errors import UserError
from dexsim.recording import read, write
from dexsim.recording.mechanism import mechanism

MODEL = """<mujoco><option {option}/><worldbody><body name="link"><joint name="j" axis="0 1 0" {joint}/>
<inertial pos="0 0 -.1" {inertial}/></body></worldbody></mujoco>"""
GOOD = {"option": "", "joint": "", "inertial": 'mass="1" diaginertia="1e-3 1e-3 1e-3"'}
SERVO = {"joints": {"*": {"kp": 2.0, "kd": 0.1}}}


@pytest.mark.parametrize("value", ["inf nan 0", "nan 0 0", "0 0 -inf", "0 0", "0 0 -981", "down", "1e999 0 0"])
def test_gravity(tmp_path, value):
    write(tmp_path / "a.mcap", recordings.signal(1.0))
    with pytest.raises(UserError, match="gravity") as error:
        read(tmp_path / "a.mcap", meta={"gravity": value})
    assert "a.mcap" in str(error.value) and "meta.gravity" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"joint": 'armature="-0.01"'}, "armature"),
        ({"joint": 'armature="nan"'}, "armature"),
        ({"joint": 'damping="-1"'}, "damping"),
        ({"joint": 'frictionloss="nan"'}, "frictionloss"),
        ({"inertial": 'mass="-1" diaginertia="1e-3 1e-3 1e-3"'}, "mass"),
        ({"inertial": 'mass="nan" diaginertia="1e-3 1e-3 1e-3"'}, "(?i)mass|nan"),
        ({"option": 'gravity="nan 0 0"'}, "gravity"),
        ({"option": 'gravity="0 0 -1e9"'}, "gravity"),
        ({"inertial": 'mass="1" diaginertia="nan 1e-3 1e-3"'}, "(?i)inertia|nan"),
    ],
)
def test_a_model(tmp_path, change, name):
    path = tmp_path / "m.xml"
    path.write_text(MODEL.format(**GOOD))
    mechanism(path, SERVO)
    path.write_text(MODEL.format(**(GOOD | change)))
    with pytest.raises(UserError, match=name) as error:
        mechanism(path, SERVO)
    assert "m.xml" in str(error.value) and "\n" not in str(error.value)
