"""An effect of the drives is added by its column, its law, its reference and its entry, in the places that
docs/howto/extending.md names; the fifth is a test. One of each kind is added to a copy of the package."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import dexsim

COLUMNS, LAWS, REFERENCE = "actuator/columns.py", "actuator/laws.py", "actuator/reference.py"


@dataclass
class Added:
    """An effect that dexsim does not have. column: the rest of its line; law: its functions, before the line `above`;
    terms, reference: (the line before which, what is added) in `laws.py` and `reference.py`; family: the file of its
    entry; entry: of its class, what no other has; hidden: its size in the demo; torque, friction: that it adds [N.m] at
    rest at 1 rad, the target 0.1 rad off and 1 remembered; believed: of the demo's drive, where its own would hardly
    show the effect; alone: a demo of one joint can show it."""

    effect: str
    words: str
    name: str
    unit: str
    column: str
    law: str
    above: str
    terms: tuple[tuple[str, str], ...]
    reference: tuple[tuple[str, str], ...]
    family: str
    starts: str
    signal: str
    hidden: float
    torque: float = 0.0
    friction: float = 0.0
    high: float = 1.0
    more: str = ""
    believed: dict[str, float] = field(default_factory=dict)
    alone: bool = True

    @property
    def entry(self) -> str:
        """Its class."""
        return f'''

class {self.effect.title().replace("_", "")}(Effect):
    """Added by a test: it {self.words}."""

    id = "{self.effect}"
    words = "{self.words}"
    shows = "somewhere"
    experiment = "sines"
    demo = {{"{self.name}": {self.hidden}}}
    {self.more}

    def variants(self, s):
        size = param("size", "{self.name}", "set", 0.0, {self.high}, 0.0, "{self.unit}")
        return [Variant((size,), {self.starts})]

    def signal(self, case, values, note):
        return {self.signal}

    def parameters(self, fit):
        return {{"size": fit.entry("size", "{self.unit}")}}
'''

    @property
    def edits(self) -> list[tuple[str, str, str]]:
        """(file, the line before which (none: at its end), what is added)."""
        line = f'    Column("{self.name}", "{self.unit}", 0.0, 0.0, 1e3, {self.column}),\n'
        return [
            (COLUMNS, "    # Torque of nothing that is known", line),
            (LAWS, self.above, self.law),
            *((LAWS, *term) for term in self.terms),
            *((REFERENCE, *term) for term in self.reference),
            (f"gap/effects/{self.family}.py", "", self.entry),
        ]


ANYWHERE = 'np.ones_like(case.regimes["position"])'
FAR = 'np.abs(case.regimes["position"]) ** 3'
CHANGES = 'np.abs(case.regimes["_command_rate"])'

TORQUE = Added(  # by position
    "cable_pull", "is pulled home by a cable", "cable", "N.m/rad3", '0.05, "pulls home", feature="cable"',
    '''PULL = INDEX["cable"]


@wp.func
def cable_pull(stiffness: Any, q: Any):
    """Torque [N.m] of a cable [N.m/rad3] at position q [rad]: -stiffness q^3."""
    return -stiffness * q * q * q


''',
    "# -- what a drive adds by itself",
    (("        return wp.vector(torque, by_position, by_speed), memory", '''        if wp.static("cable" in features):
            torque += cable_pull(of[PULL], q)
            by_position -= type(q)(3.0) * of[PULL] * q * q
'''),),
    (("    return torque, by_position, by_speed", '''    if "cable" in features:
        torque = torque - p["cable"] * q**3
        by_position = by_position - 3 * p["cable"] * q**2
'''),),
    "body", "((0.02,), (0.1,), (0.4,))", FAR, 0.08, torque=-0.08, high=2.0,
)  # fmt: skip
FRICTION = Added(
    "worn_gear", "rubs at one side of its turn", "wear", "N.m", '0.02, "friction at one side", feature="wear"',
    '''WEAR = INDEX["wear"]


@wp.func
def worn(friction: Any, q: Any):
    """Dry friction [N.m] of a gear that is worn at one side of its turn, q [rad]: friction (1 + sin q) / 2."""
    return type(q)(0.5) * friction * (type(q)(1.0) + wp.sin(q))


''',
    "@cache\ndef dry_friction(",
    ((
        "        return wp.vector(steady, fading, loaded, loaded_fading), memory",
        '''        if wp.static("wear" in features):
            steady += warm * worn(of[WEAR], q)
''',
    ),),
    (("    return level\n", '''    if "wear" in features:
        level = level + 0.5 * p["wear"] * (1.0 + np.sin(q))
'''),),
    "friction", "((0.02,), (0.1,), (0.3,))", '1.0 + np.sin(case.regimes["position"])', 0.1,
    friction=0.05 * (1.0 + np.sin(1.0)), high=2.0,
)  # fmt: skip
LOPSIDED = Added(  # how friction acts
    "lopsided_seal", "rubs more one way at one side", "lopsided", "1",
    '0.4, "friction by direction", feature="lopsided"',
    '''LOPSIDED = INDEX["lopsided"]


@wp.func
def lopsided(size: Any, q: Any):
    """Share of the dry friction that a seal adds moving positive, and takes off moving negative, at q [rad]."""
    return size * wp.sin(q)


''',
    "@cache\ndef friction_acts(",
    (("        return wp.vector(uneven, give), memory", '''        if wp.static("lopsided" in features):
            uneven += lopsided(of[LOPSIDED], q)
'''),),
    (("    return uneven, give\n", '''    if "lopsided" in features:
        uneven = uneven + p["lopsided"] * np.sin(q)
'''),),
    "friction", "((0.2,), (0.6,), (1.0,))", 'np.abs(np.sin(case.regimes["position"]))', 0.8,
    torque=-0.8 * np.sin(1.0) * 0.08, high=2.0, believed={"coulomb_friction": 0.08},
)  # fmt: skip
ENCODER = Added(
    "tilted_encoder", "has an encoder whose disk is tilted", "tilt", "rad",
    '0.05, "error, twice a turn", feature="tilt", encoder=True',
    '''TILT = INDEX["tilt"]


@wp.func
def tilted(size: Any, q: Any):
    """(error [rad] at position q [rad] of an encoder whose disk is tilted, size sin 2q, its slope)."""
    two = type(q)(2.0)
    return wp.vector(size * wp.sin(two * q), two * size * wp.cos(two * q))


''',
    "@cache\ndef encoder_error(",
    (("        return wp.vector(first, error, slope)", '''        if wp.static("tilt" in features):
            by_tilt = tilted(of[TILT], q)
            error += by_tilt[0]
            slope += by_tilt[1]
'''),),
    (("    return reading, slope\n", '''    if "tilt" in features:
        reading = reading + p["tilt"] * xp.sin(2.0 * q)
        slope = slope + 2.0 * p["tilt"] * xp.cos(2.0 * q)
'''),),
    "signals", "((0.03,), (0.1,))", 'np.abs(np.sin(2 * case.regimes["position"]))', 0.12,
    # the loop's own torque holds against it: what gravity and friction are at the true pose is little
    torque=-2.0 * 0.12 * np.sin(2.0), high=0.3, more="misreads = True",
)  # fmt: skip
LOOP = Added(  # of its error
    "soft_dead_zone", "hardly acts on small errors", "dead_zone", "rad", '0.05, "of errors", feature="dead_zone"',
    '''DEAD_ZONE = INDEX["dead_zone"]


@wp.func
def soft_dead_zone(width: Any, e: Any):
    """(what of an error e [rad] does not count, width tanh(e / width), its slope)."""
    share = wp.tanh(e / width)
    return wp.vector(width * share, type(e)(1.0) - share * share)


''',
    "@cache\ndef lost_error(",
    ((
        "        if wp.abs(error) < width:\n            acts = type(e)(0.0)\n            if kind",
        '''        if wp.static("dead_zone" in features):
            if of[DEAD_ZONE] > type(e)(0.0):
                soft = soft_dead_zone(of[DEAD_ZONE], error)
                lost += soft[0]
                slope += soft[1]
''',
    ),),
    (("    return lost, slope, np.where(inside", '''    if "dead_zone" in features:
        over = np.tanh(e / np.maximum(p["dead_zone"], 1e-12))
        lost, slope = lost + p["dead_zone"] * over, slope + (p["dead_zone"] > 0.0) * (1.0 - over**2)
'''),),
    "drive", "((0.01,), (0.03,), (0.1,))", ANYWHERE, 0.05, torque=-2.0 * 0.05 * np.tanh(2.0), high=0.5,
)  # fmt: skip
SMOOTHED = Added(  # of its target, with a memory
    "smoothed_target", "smooths its targets", "smoothing", "s",
    '0.05, "lag of the targets", feature="smoothing", remembers=("smoothed",)',
    '''SMOOTHING, SMOOTHED = INDEX["smoothing"], MEMORY["smoothed"]


@wp.func
def smoothed(time: Any, before: Any, target: Any, fresh: bool, dt: Any):
    """Target [rad] after a lag [s] of first order, `before` the step of dt [s]."""
    out = target
    if not fresh:
        out = before + lag_share(time, dt) * (target - before)
    return out


''',
    "@cache\ndef lost_error(",
    (("        return wp.vector(lost, slope, acts), memory", '''        if wp.static("smoothing" in features):
            memory[SMOOTHED] = smoothed(of[SMOOTHING], memory[SMOOTHED], target, fresh, dt)
            lost += target - memory[SMOOTHED]
'''),),
    (("    return lost, slope, np.where(inside", '''    if "smoothing" in features:
        share = step.dt / np.maximum(p["smoothing"] + step.dt, 1e-12)
        before = np.where(step.fresh, target, step.memory["smoothed"])
        step.memory["smoothed"] = before + share * (target - before)
        lost = lost + target - step.memory["smoothed"]
'''),),
    "signals", "((0.01,), (0.03,), (0.1,))", CHANGES, 0.05, torque=-2.0 * 0.1, high=0.3,
)  # fmt: skip
DELAY = Added(
    "swinging_delay", "acts on its targets later at times", "swing", "s",
    '0.02, "swing of the delay", feature="swing", delays=True',
    '''SWING = INDEX["swing"]


@wp.func
def swinging(size: Any, t: Any):
    """Delay [s] at time t [s] that swings between 0 and `size` once a second."""
    return type(t)(0.5) * size * (type(t)(1.0) - wp.cos(type(t)(6.283185307179586) * t))


''',
    "@cache\ndef command_delay(",
    (("        return late, memory", '''        if wp.static("swing" in features):
            late += swinging(of[SWING], t)
'''),),
    (("    return late\n", '''    if "swing" in features:
        late = late + 0.5 * p["swing"] * (1.0 - np.cos(2.0 * np.pi * t))
'''),),
    "signals", "((0.01,), (0.05,), (0.1,))", CHANGES, 0.08, high=0.3,
)  # fmt: skip
WEARY = Added(  # what a motor can do, with a memory
    "weary_motor", "weakens as it works", "weary", "1/(N.m)",
    '0.3, "loss by recent torque", feature="weary", remembers=("worked",)',
    '''WEARY, WORKED = INDEX["weary"], MEMORY["worked"]


@wp.func
def weary(share: Any, worked: Any):
    """Factor on a motor's efficiency after `worked` [N.m], the mean size of its torque of the last 0.05 s."""
    return type(worked)(1.0) / (type(worked)(1.0) + share * worked)


''',
    "@cache\ndef warm_motor(",
    (("        return wp.vector(tau0, no_load, efficiency, rubs), memory", '''        if wp.static("weary" in features):
            before = memory[WORKED]
            if fresh:
                before = wp.abs(torque)
            memory[WORKED] = before + lag_share(type(dt)(0.05), dt) * (wp.abs(torque) - before)
            efficiency = efficiency * weary(of[WEARY], memory[WORKED])
'''),),
    (("    return tau0, no_load, efficiency, rubs\n", '''    if "weary" in features:
        before = np.where(step.fresh, np.abs(torque), step.memory["worked"])
        step.memory["worked"] = before + step.dt / (0.05 + step.dt) * (np.abs(torque) - before)
        efficiency = efficiency / (1.0 + p["weary"] * step.memory["worked"])
'''),),
    "drive", "((0.3,), (1.0,), (3.0,))", CHANGES, 4.0,
    torque=2.0 * 0.1 * (1.0 / 5.0 - 1.0), high=10.0,
)  # fmt: skip
TENDON = Added(  # by another joint
    "soft_tendon", "is dragged by a tendon that gives", "tendon", "1/rad", '0.3, "drag", feature="rare"',
    '''TENDON = INDEX["tendon"]


@wp.func
def soft_tendon(size: Any, away: Any):
    """Shift of a target [rad] by a tendon that gives, `away` [rad] at its other end."""
    return size * away * wp.abs(away)


''',
    "@cache\ndef dragged_target(",
    (("        return shift, memory", '''        if wp.static("rare" in features):
            shift += soft_tendon(of[TENDON], away)
'''),),
    (("    return shift\n", '''    if "rare" in features:
        shift = shift + p["tendon"] * away * np.abs(away)
'''),),
    "body", "((0.1,), (0.3,))", ANYWHERE, 0.3, alone=False,
)  # fmt: skip
CELL = Added(  # by the supply that all load
    "weak_cell", "has a cell that weakens under load", "cell", "1/(N.m)^2", '0.1, "loss", feature="sag"',
    '''CELL = INDEX["cell"]


@wp.func
def weak_cell(size: Any, others: Any):
    """What is left of a supply that others load with |torque| [N.m]: 1 / (1 + size others^2)."""
    return type(others)(1.0) / (type(others)(1.0) + size * others * others)


''',
    "@cache\ndef supply_left(",
    (("        return there, memory", '''        if wp.static("sag" in features):
            there = there * weak_cell(of[CELL], others)
'''),),
    (("    return there\n", '''    if "sag" in features:
        there = there / (1.0 + p["cell"] * others**2)
'''),),
    "drive", "((0.1,), (0.3,))", ANYWHERE, 0.3, alone=False,
)  # fmt: skip
ALL = (TORQUE, FRICTION, LOPSIDED, ENCODER, LOOP, SMOOTHED, DELAY, WEARY, TENDON, CELL)

TRIED = """
import json, sys
from pathlib import Path
import numpy as np
import torch
import servo_reference
from dexsim.actuator import Servo
from dexsim.actuator.columns import INDEX, MEMORY
from dexsim.actuator.table import ServoTable
from dexsim.gap import demo
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.tasks.randomize import Sampler
from dexsim.tasks.servos import ServoRandomizer

effect, column, believed = sys.argv[1:]
out, beside = Path(effect), "payload" if effect == "cable_pull" else "coulomb_friction"
demo.BELIEVED["joints"]["*"] |= json.loads(believed)

class Drives:  # of 400 worlds
    joints, queue, control_period = ("joint",), 8, 0.02
    table = ServoTable.from_dict(demo.BELIEVED)
    nominal = torch.as_tensor(table.nominal(joints), dtype=torch.float32)
    params = nominal.expand(400, *nominal.shape).clone()
    check_simulated = Servo.check_simulated

paths, model, servo, hidden = demo.make(out, effect, seconds=5.0)
d = diagnose(Settings(paths, out, None, str(model), str(servo), next_recording=False, allowed={effect, beside}),
             say=lambda _: None)
save(d, out)
row = ServoTable.from_dict(demo.BELIEVED).nominal(["joint"])[0]
without, there = (servo_reference.servo(r, 1.1, 1.0, 0.0, dt=1e-9, features={column}, fresh=0.0, last=1.0,
                                  memory={name: np.ones(()) for name in MEMORY})
                  for r in (row, np.where(np.arange(len(row)) == INDEX[column], hidden[column], row)))
Drives.features = frozenset({column})
ServoRandomizer(Drives(), Sampler({"servo": {column: [0.02, 0.06]}}, torch.Generator().manual_seed(0), 400,
                "cpu")).draw(torch.ones(400).bool())
drawn = Drives.params[:, 0, INDEX[column]]
print(json.dumps({"hidden": hidden, "drawn": [float(drawn.min()), float(drawn.max())],
    "torque": float(there["qfrc_applied"] - without["qfrc_applied"]),
    "friction": float(there["dof_frictionloss"] - without["dof_frictionloss"]),
    "row": ServoTable.load(out / "servo.yaml").value("joint", column).value}))
"""


@pytest.fixture(scope="module")
def grown(tmp_path_factory) -> Path:
    """Return a folder with a copy of the package that has all of them."""
    folder = tmp_path_factory.mktemp("grown")
    package = folder / "dexsim"
    shutil.copytree(Path(dexsim.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    for name, before, text in (edit for added in ALL for edit in added.edits):
        path = package / name
        old = path.read_text(encoding="utf-8")
        assert old.count(before) == 1 or not before, f"{name}: {before}"
        path.write_text(old.replace(before, text + before) if before else old + text, encoding="utf-8")
    (folder / "tried.py").write_text(TRIED, encoding="utf-8")
    for name in ("test_servo.py", "servo_reference.py"):
        shutil.copy(Path(__file__).with_name(name), folder)
    return folder


def printed(folder: Path, *command: str) -> str:
    """Return what a Python command prints with the copy."""
    env = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run([sys.executable, *command], cwd=folder, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def test_every_kind_of_law_is_added_in_the_places_that_the_docs_name():
    """Column, law, reference and entry, and no other file; each function of `laws.py` that puts laws together has one
    that is added to it."""
    for added in ALL:
        assert {name for name, _, _ in added.edits} == {COLUMNS, LAWS, REFERENCE, f"gap/effects/{added.family}.py"}
    source = (Path(dexsim.__file__).parent / LAWS).read_text(encoding="utf-8")
    where = [source.rindex("@cache\ndef ", 0, source.index(line)) for a in ALL for line, _ in a.terms]
    together = {source[at:].split("def ", 1)[1].split("(")[0] for at in where}
    assert together | {"heard_speed"} == {  # `speed_lag` is one of heard_speed's
        line.split("def ")[1].split("(")[0] for line in source.split("@cache\n")[1:] for line in line.splitlines()[:1]
    }


@pytest.mark.slow
def test_kernel_and_reference_agree_on_what_was_added(grown):
    compared = printed(grown, "-m", "pytest", "-q", "-p", "no:xdist", "test_servo.py", "-k", "agrees and all_features")
    assert "4 passed" in compared  # both drives, in either precision


@pytest.mark.slow
@pytest.mark.parametrize("added", [a for a in ALL if a.alone], ids=lambda a: a.effect)
def test_an_effect_is_added_by_its_column_its_law_and_its_entry(grown, added):
    """Drawn for training, planted by the engine that trains, found, sized, taken for explained, written to servo.yaml
    and shown on the page."""
    answer = printed(grown, "tried.py", added.effect, added.name, json.dumps(added.believed))
    (said,) = (json.loads(x) for x in answer.splitlines() if x.startswith("{"))
    out = grown / added.effect
    first = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))["findings"][0]
    found = first["parameters"]["size"]["value"]
    assert said["hidden"] == {added.name: added.hidden}
    assert said["torque"] == pytest.approx(added.torque, rel=1e-3, abs=1e-9)
    assert said["friction"] == pytest.approx(added.friction, rel=1e-3, abs=1e-9)
    assert first["effect"] == added.effect and found == pytest.approx(added.hidden, rel=0.1)
    assert said["drawn"] == [pytest.approx(0.02, abs=1e-3), pytest.approx(0.06, abs=1e-3)]
    assert said["row"] == pytest.approx(found, rel=1e-3)
    assert added.words in (out / "report.html").read_text(encoding="utf-8")
