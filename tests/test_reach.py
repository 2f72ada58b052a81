"""Targets and positions that no motion of the joint explains: said, and left out, also where they repeat."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import recordings

from dexsim.actuator.table import ServoTable
from dexsim.gap.read import Run, channels, inputs
from dexsim.recording.audit import audit as audited
from dexsim.recording.schema import COMMANDS, STATES

MODEL = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" range="-1 1" limited="true"/>
 <geom size=".02" mass=".1" pos="0 0 -.1"/>
<body pos="0 0 -.2"><joint name="b" axis="0 1 0"/><geom size=".02" mass=".1" pos="0 0 -.1"/></body></body></worldbody>
 </mujoco>"""


def said(r, topic):
    return [f for f in audited(r) if f.kind == "unit" and f.topic == topic and f.severity == "error"]


@pytest.mark.parametrize("quantity", ["command", "position"])
@pytest.mark.parametrize(
    "damage",
    [
        lambda x, rng: x * 4096,
        lambda x, rng: x * 250,
        lambda x, rng: np.where(rng.random(len(x)) < 0.3, 184.0, x),
        lambda x, rng: np.where((np.arange(len(x)) % 100) < 4, 184.0, x),
        lambda x, rng: np.where(np.arange(len(x)) // 20 == 7, -184.0, x),
        lambda x, rng: np.full(len(x), 1e5) + x,
    ],
    ids=["4096 times", "250 times", "now and then", "four in a row", "for 0.2 s", "shifted"],
)
def test_numbers_far_from_the_other_signal_are_said(quantity, damage):
    r = recordings.signal()
    series = r.commands if quantity == "command" else r.states.position
    before = said(r, series.topic)
    series.value = series.value.copy()
    series.value[:, 0] = damage(series.value[:, 0], np.random.default_rng(0))
    found = said(r, series.topic)
    assert not before and quantity in found[0].text and found[0].joint == "a"
    assert {f.joint for f in found} == {"a"} and (r.path.name, "a") in channels.spoiled(with_findings(r, found))


def with_findings(r, found):
    r.findings = found
    return [r]


def wheel(r):
    r.states.position.value[:, 0] = 40 * r.states.position.t
    r.commands.value[:, 0] = 40 * r.commands.t


def steps(r):
    """Return a wheel that is sent five turns on now and then, and goes there."""
    t = r.commands.t
    r.commands.value[:, 0] = 10 * np.pi * np.floor(t / 2)
    r.states.position.value[:, 0] = np.interp(r.states.position.t - 0.3, t, r.commands.value[:, 0])


def still(r):
    r.commands.value[:, 0] = 0.0


def dangles(r):
    """Return a joint whose target does not move, and which is turned by hand, three turns."""
    r.commands.value[:, 0] = 0.1
    r.states.position.value[:, 0] = 6 * np.pi * np.sin(0.4 * r.states.position.t)


def weak(r):
    r.states.position.value[:, 0] *= 0.03


def spikes(r):
    at = np.random.default_rng(1).choice(len(r.commands.t), 30, replace=False)
    r.commands.value[at, 0] = 184.0


@pytest.mark.parametrize("change", [lambda r: None, wheel, steps, still, dangles, weak, spikes])
def test_what_a_joint_may_do_is_not(change):
    r = recordings.signal()
    r.commands.value, r.states.position.value = r.commands.value.copy(), r.states.position.value.copy()
    change(r)
    assert not [f for topic in (COMMANDS, STATES) for f in said(r, topic) if "none of this joint's" in f.text]


SERVO = ServoTable.from_dict({"joints": {"*": {"kp": 1.0, "kd": 0.02, "torque_limit": 1.0}}})


@pytest.mark.parametrize(
    "change, topics",
    [
        (lambda run: run.cmd.__setitem__((slice(100, 140), 0), 184.0), [COMMANDS]),
        (lambda run: run.cmd.__setitem__((slice(100, 140), 0), -9.0), [COMMANDS]),
        (lambda run: run.q.__setitem__((slice(0, 400), 0), 30.0), [STATES]),
        (lambda run: (run.q.__imul__(900.0), run.cmd.__imul__(900.0)), [STATES, COMMANDS]),
        (lambda run: run.cmd.__setitem__((slice(100, 140), 1), 184.0), None),
        (lambda run: run.cmd.__setitem__((slice(100, 140), 0), 3.0), None),
        (lambda run: None, None),
    ],
    ids=["targets", "a turn out", "positions", "both", "a joint without a range", "on its stop", "sound"],
)
def test_what_lies_far_outside_the_models_range_is_left_out(change, topics):
    r = recordings.signal()
    run = Run("x.mcap", r.joints, r.commands.t, r.commands.value.copy(), r.states.position.t.copy(),
              r.states.position.value.copy(), SERVO, r.gravity, counted=r.joints)  # fmt: skip
    change(run)
    found, out, _ = channels.inspect([run], mujoco.MjModel.from_xml_string(MODEL), {})
    far = [f for f in found if "the model allows" in f.regime]
    assert [list(f.topics) for f in far] == ([topics] if topics else [])
    assert (("x.mcap", "a") in out) == bool(topics)


@pytest.mark.parametrize("kp, is_spoiled", [(3e-4, False), (2.0, True)])
def test_far_targets_of_a_drive_without_a_loop_spoil_nothing(kp, is_spoiled):
    """The audit knows no gains: through a small one targets far off are a torque that the drive can give."""
    r = recordings.signal()
    r.commands.value = 800.0 * np.sign(r.commands.value)
    with_findings(r, said(r, COMMANDS))
    assert {f.joint for f in r.findings} == {"a", "b"}
    servo = ServoTable.from_dict({"joints": {"*": {"kp": kp, "kd": 0.0, "torque_limit": 1.0}}})
    run = Run(r.path.name, r.joints, r.commands.t, r.commands.value, r.states.position.t, r.states.position.value,
              servo, r.gravity)  # fmt: skip
    openly = channels.driven_openly([run])
    assert bool(channels.spoiled([r], openly)) == is_spoiled
    assert bool(inputs.channel_findings([r], r.joints, {}, openly)) == is_spoiled
    assert channels.spoiled([r])  # where nothing is known of the drive
