"""A policy on a hand: dexsim deploy bundle=DIR driver=sim seconds=10."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import threading
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, Self

from dexsim import door, system, typed
from dexsim.console.stop import Stop
from dexsim.errors import UserError

USAGE = """usage: dexsim deploy bundle=DIR [key=value ...]
       dexsim deploy check [key=value ...]      the first hour with a hand, step by step (dexsim deploy check --help)

Run a policy bundle in real time: home slowly, run the policy, relax. Ctrl-C, SIGTERM and SIGHUP relax at once. Stand
clear of a real hand, and try driver=sim first. On a machine that does other work too, run it with real-time priority
(chrt -r 10 dexsim deploy ...).

settings (key=default):
  bundle=             folder of dexsim export
  driver=sim          sim, xhand (the vendor's package), ros2, what an installed package brings, or module:Class
  port=auto           driver=xhand: auto asks every serial port for the hand; a port (/dev/ttyACM1), ethercat or
                      ethercat:INTERFACE; fake: the simulated hand behind a fake of the vendor's package, with faults
                      as in fake:crc=0.005,board=2 (dexsim/deploy/fake_xhand.py)
  serial=             driver=xhand: the hand with this serial number, of several
  second=             driver=xhand: bundle of a second hand on the same bus, of its side; some 50 readings a second each
                      (second_serial=, second_place=, second_calibration= are as those of the first)
  ros2=               driver=ros2: topics of states and commands (default: /joint_states,/joint_commands), both
                      sensor_msgs/JointState; a command's effort is the current limit [mA], 0 lets go
  ros2_message=       joint_state, or xhand: the messages of the vendor's ROS driver (needs rclpy)
  ros2_effort=1       mA a unit of the states' effort
  seconds=10          of the policy, after homing
  command=            what the policy is told: grasp, a force, 0..1 of F_max (default 0.5), and the thumb's own after
                      it where the policy takes one; a task of your own, the numbers of its commands, as in
                      "1 0 0 0" (default: the bundle's)
  calibration=        calibration.yaml instead of the bundle's
  record=             FILE.mcap, a new one, of everything seen and sent (default: out/deploy_<date>.mcap;
                      record=none: nothing)
  vision=truth        driver=sim: truth, or camera (a rendered depth image and mask); driver=xhand: place="x y z" [m]
  place=              the object's place in the palm frame where nothing sees it, e.g. place="0.055 0 0.04"
  imu=                rotate with an IMU in the cube, driver=xhand: udp:PORT, on which a program of yours
                      sends lines "w x y z";
                      udp:PORT:FROM takes them from that port alone (default: from whoever sends the first good one)
  shape=              driver=sim, grasp: the object's shape
  seed=0              driver=sim
safety (key=default):
  tor_max=            firmware current limit [mA] (default: the calibration's current_max; driver=xhand: at most 400)
  kp=100              firmware stiffness
  speed=0.6           largest speed of targets, over the joints' no-load speed
  margin=0            rad kept free at the joint limits
  home_speed=0.5      rad/s of the homing
  wait=3              rotate: s that the open hand then waits for the cube; grip=1: s its fingers take to close on it
  stale=0.12          s: a reading older than this relaxes the hand; late=0.1, hang=0.15, overruns=10 likewise
  ahead=0             s by which the object's pose is carried on: your camera's delay less that of training
  noise=0             1: the noise on actions that the policy was trained with, without which some freeze
  seen=               s: so does what was last seen of the object (default: 0.5 of a camera, 0.1 of an IMU)
  read_hz=100         readings a second
  recover=false       home again when readings are good again, instead of ending
"""
SECOND = ("second", "second_serial", "second_place", "second_calibration")
OWN = (*SECOND, *typed.defaults(USAGE), "task")
USED_BY = {
    "port": ("xhand", "fake"), "serial": ("xhand", "fake"), "ros2": ("ros2",), "ros2_message": ("ros2",),
    "ros2_effort": ("ros2",), "vision": ("sim", "fake"), "shape": ("sim", "fake"), "seed": ("sim", "fake"),
    "imu": ("xhand", "ros2"),
}  # fmt: skip
"""The drivers that use a setting; fake: driver=xhand port=fake."""


def main(argv: Sequence[str]) -> int:
    """Returns the exit status: 0 done, 1 relaxed by a watchdog, 130 Ctrl-C, 143 SIGTERM, 129 SIGHUP. Raises
    UserError."""
    if argv[0] == "check":
        from dexsim.cli import first_hour

        return first_hour.main(argv[1:])
    given, changes = _settings(argv)
    import torch

    from dexsim import files, outputs
    from dexsim.tasks import registry

    if "task" in given:
        registry.find(given["task"])
    torch.set_num_threads(1)
    if "bundle" not in given:
        raise UserError("say which policy: bundle=DIR (dexsim export writes one)")
    all_given = [{k: v for k, v in given.items() if k not in SECOND}]
    if "second" in given:
        more = {k.removeprefix("second_"): v for k, v in given.items() if k in SECOND}
        shared = {k: v for k, v in all_given[0].items() if f"second_{k}" not in SECOND}
        all_given.append(shared | more | {"bundle": given["second"]})
        if given.get("record") != "none":
            path = files.place(given.get("record") or _recording())
            all_given[0]["record"] = str(path)
            all_given[1]["record"] = str(outputs.new(path.with_name(f"{path.stem}_second.mcap"), "record="))
    elif wrong := [k for k in SECOND if k in given]:
        raise UserError(f"{wrong[0]}={given[wrong[0]]}: says something of a second hand, but second=DIR names none")
    loops = _loops(all_given, changes)
    if given.get("driver", "sim") != "sim":
        print("note     if this computer dies, the hand keeps its last target: keep its power switch within reach")
    print(f"driver   {', '.join(loop.driver.name for loop in loops)}; starting ...", flush=True)
    with _Stop() as stop:
        try:
            _run(loops)
        finally:
            stop.ending = True
            try:
                _each([loop.driver.close for loop in loops])
            finally:
                for loop in loops:
                    with contextlib.suppress(OSError):  # the terminal may be gone
                        _ending(loop.report, loop.recorder, loop.driver.name if len(loops) > 1 else "hand")
                        if rescued := getattr(loop.driver, "rescued", ""):
                            print(f"since    {rescued}", flush=True)
    return 0 if all(loop.report.ended == "done" for loop in loops) else stop.status or 1


def _loops(all_given: Sequence[dict[str, str]], changes: dict[str, Any]) -> list[Any]:
    """Return a loop for each hand. Raises UserError."""
    from dexsim.calibration.file import Calibration
    from dexsim.deploy import bundle as bundles
    from dexsim.deploy.loop import Loop, LoopSettings
    from dexsim.deploy.process import HANG

    found = []
    for given in all_given:
        b = bundles.load(given["bundle"])
        calibration = b.calibration
        if "calibration" in given:
            calibration = Calibration.load(given["calibration"], b.manifest["normalization"]["tau_max"], b.hand)
        mine = dict(changes)
        if given.get("port", "").startswith("fake"):
            mine.setdefault("seen", 0.3)  # the fake's world is seen over its bus: after its pauses and outliers
        elif given.get("driver") == "xhand" and "tor_max" not in mine:
            from dexsim.deploy.vendor import MOST_CURRENT

            mine["tor_max"] = tuple(min(1e3 * float(x), MOST_CURRENT) for x in calibration.current_max)
            print(f"note     no motor gets more than {max(mine['tor_max']):.0f} mA; tor_max= says otherwise")
        settings = LoopSettings(**mine)
        settings.check()
        found.append((given, b, calibration, settings))
    hands = _two_hands(found, changes.get("hang", HANG)) if len(found) > 1 else [None]
    loops = []
    pairs = [_hand(*x[:3], x[3].hang, hand) for x, hand in zip(found, hands, strict=True)]  # before there are files
    for (given, b, calibration, settings), (driver, eye) in zip(found, pairs, strict=True):
        for text in calibration.assumed:
            print(f"note     {text}")
        name = f"{driver.name:<11}" if len(found) > 1 else ""
        loop = Loop(b, driver, eye, calibration, settings, say=partial(print, name, sep="", flush=True))
        loop.recorder = _recorder(given, b, settings, calibration)
        rate = 1 / b.manifest["rates"]["policy_period_s"]
        print(f"bundle   {b.path}, policy {rate:.1f} Hz, readings {settings.read_hz:g} Hz")
        loops.append(loop)
    return loops


def _two_hands(found: Sequence[tuple], hang: float) -> list[Any]:
    """Return drivers of two xHands on one bus."""
    from dexsim.deploy.vendor import VendorXHands

    given, b, calibration, _ = found[0]
    if given.get("driver") != "xhand":
        raise UserError(f"second={found[1][0]['bundle']}: two hands on a bus are for driver=xhand")
    sides = [x[1].hand.handedness for x in found]
    package, port = None, given.get("port", "auto")
    if port.split(":")[0] == "fake":
        from dexsim.deploy.simulated_hand import fake_package

        faults = f"side={sides[0][0].upper()},second=FAKE0002,{port.partition(':')[2]}"
        package, port = fake_package(b.config, calibration, faults, grip=b.manifest.get("grip")), "auto"
    bus = VendorXHands([x[0].get("serial") for x in found], sides, port, package=package, hang=hang)
    bus.start = 180.0
    return bus.hands


def _run(loops: Sequence[Any]) -> None:
    """Run the loops, of two hands each in a thread; a signal ends both."""
    if len(loops) == 1:
        loops[0].run()
        return
    loops[0].driver.open()
    failed: list[BaseException] = []

    def work(loop: Any) -> None:
        try:
            loop.run()
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=work, args=(loop,)) for loop in loops]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        try:
            for thread in threads:
                thread.join(0.05)
        except KeyboardInterrupt as error:
            for loop in loops:
                loop.report.ended = loop.report.ended or str(error) or "stopped by Ctrl-C"
                loop.stop.set()
    if failed:
        raise failed[0]


def _each(works: Sequence[Any]) -> None:
    """Call all; what the first that fails raises comes after the last."""
    with contextlib.ExitStack() as stack:
        for work in reversed(works):
            stack.callback(work)


class _Stop(Stop):
    """Ctrl-C, Ctrl-Z, SIGTERM, SIGHUP, SIGQUIT and all others that a process can handle: the first ends the run, which
    relaxes the hand; those after it change nothing. ending: the hand is relaxed, what remains is done to its end."""

    def __init__(self) -> None:
        super().__init__()
        self.status, self.ending, self._names = 0, False, system.hand_signals()

    def signals(self) -> dict[int, str]:
        return self._names

    def __enter__(self) -> Self:
        super().__enter__()
        if not self._before:
            raise RuntimeError("only a program's main thread is told of signals, which a hand must be let go at")
        return self

    def _handle(self, number: int, _frame: Any) -> None:
        if not self.status and not self.ending:
            self.status = 128 + number
            raise KeyboardInterrupt(f"stopped by {self._names[number]}")


def _ending(report: Any, recorder: Any, name: str = "hand") -> None:
    """Print what the run was."""
    if report.not_relaxed:
        print(f"\nDANGER   the {name} could not be relaxed ({report.not_relaxed}): cut its power", flush=True)
    hand = f"the {name} may still drive" if report.not_relaxed else f"the {name} is relaxed"
    hand += f" ({report.limp})" if report.limp else ""
    print(f"\nended    {report.ended or 'failed'} after {report.acts} actions; {hand}")
    print(report.timing.table())
    print("counts   " + (", ".join(f"{k} {v}" for k, v in sorted(report.counts.items())) or "none"))
    if recorder is not None:
        lost = f"; {recorder.error}" if recorder.error else ""
        what = f"{recorder.path} ({recorder.written} samples, {recorder.dropped} dropped){lost}"
        print(f"mcap     {what if recorder.written or lost else 'none: there was nothing to record'}", flush=True)


def _hand(given: dict[str, str], b: Any, calibration: Any, hang: float, hand: Any = None) -> tuple[Any, Any]:
    """Return the driver, `hand` where there is one of several on a bus, and what sees the object."""
    import numpy as np

    from dexsim.deploy.measure import ORIENTATION, PLACE, of
    from dexsim.deploy.vision import FixedPlace

    kind, task = given.get("driver", "sim"), b.manifest["task"]
    for key in ("vision", "place", "shape", "imu"):
        if key in given and key not in of(task).OPTIONS:
            raise UserError(f"{key}={given[key]}: the policy in {b.path} is of task={task}, which does not use it")
    place = None
    if "place" in given:
        at = np.array([typed.real(x) for x in given["place"].replace(",", " ").split()])
        if at.shape != (3,) or not (np.abs(at) < 0.5).all():
            raise UserError(f"place={given['place']}: must be x y z in the palm frame, three numbers within 0.5 m")
        place = FixedPlace(at)
    fake = kind == "xhand" and given.get("port", "").split(":")[0] == "fake"
    if kind not in ("sim", "xhand", "ros2"):
        return _own(kind, given, b, calibration, place)
    if kind == "xhand" and b.hand.name != "xhand":
        raise UserError(
            f"driver=xhand: the policy in {b.path} is for hand={b.hand.name}; run the Loop with a HandDriver of that"
            " hand (dexsim/deploy/driver.py)"
        )
    by = "fake" if fake else kind
    if wrong := next((k for k in given if by not in USED_BY.get(k, (by,))), ""):
        raise UserError(f"{wrong}={given[wrong]}: driver={kind} does not use it{' with port=fake' * fake}")
    if by in ("ros2", "xhand") or hand is not None:
        needs = of(task).Measured(b, calibration).needs
        if needs == PLACE and place is None:
            raise UserError(
                f'driver={kind}: nothing sees the object; state place="x y z" [m, palm frame], or run the Loop with'
                " your own HeightSource (dexsim.deploy.vision)"
            )
        driver: Any = hand
        if kind == "ros2":
            driver = _ros2(given, b.hand)
        elif hand is None:
            from dexsim.deploy.vendor import VendorXHand

            side = b.hand.handedness
            driver = VendorXHand(given.get("port", "auto"), serial=given.get("serial"), side=side, hang=hang)
        return driver, _imu(given) if needs == ORIENTATION else place
    vision = typed.one_of("vision", given.get("vision", "truth"), ("truth", "camera"))
    config = b.config
    shapes = [*config["task"]["objects"]["train"], *config["task"]["objects"]["held_out"]]
    if given.get("shape") not in (None, *shapes):
        raise UserError(f"shape={given['shape']}: must be one of {', '.join(shapes)}")
    seed, grip = typed.whole("seed", given.get("seed", "0")), b.manifest.get("grip")
    from dexsim.deploy.simulated_hand import SimulatedXHand, faked

    how: dict[str, Any] = dict(seed=seed, camera=vision == "camera", shape=given.get("shape"), grip=grip, hang=hang)
    simulated: Any = (
        faked(config, calibration, given["port"].partition(":")[2], serial=given.get("serial"), **how)
        if fake else SimulatedXHand(config, calibration, **how)
    )  # fmt: skip
    return simulated, place or simulated


def _own(kind: str, given: dict[str, str], b: Any, calibration: Any, place: Any) -> tuple[Any, Any]:
    """Return a driver that an installed package brings (an entry point of the group `dexsim.drivers`), or that is named
    in full: called with hand=, port= (None where none is given) and calibration=; and what sees the object."""
    brought = door.installed("dexsim.drivers")
    if kind not in brought and not door.is_named(kind):
        known = ", ".join(("sim", "xhand", "ros2", *brought))
        raise UserError(f"driver={kind}: must be {known}, or module:Class of your own")
    make = door.load(brought[kind].value if kind in brought else kind, f"driver={kind}")
    driver = make(hand=b.hand, port=given.get("port"), calibration=calibration)
    lacks = [x for x in ("open", "read", "send", "relax", "close") if not callable(getattr(driver, x, None))]
    if lacks:
        raise UserError(f"driver={kind}: has no {', '.join(lacks)}; see dexsim.deploy.driver.HandDriver")
    return driver, place or (_imu(given) if "imu" in given else driver)


def _ros2(given: dict[str, str], hand: Any) -> Any:
    from dexsim.deploy.ros2 import COMMAND, MESSAGES, STATE, Ros2Hand

    state, _, command = given.get("ros2", "").partition(",")
    message = typed.one_of("ros2_message", given.get("ros2_message", MESSAGES[0]), MESSAGES)
    effort = typed.real(given.get("ros2_effort", "1"))
    if not 0 < abs(effort) < 1e6:
        raise UserError(f"ros2_effort={given['ros2_effort']}: must be a number of mA, within 1e6 and not 0")
    return Ros2Hand(hand, state or STATE, command or COMMAND, message=message, effort=effort)


def _imu(given: dict[str, str]) -> Any:
    """Return the IMU in the object."""
    from dexsim.deploy.imu import UdpImu

    found = re.fullmatch(r"udp:([0-9]+)(?::([0-9]+))?", given.get("imu", ""))
    if found is None:
        raise UserError(
            f'imu={given.get("imu", "")}: nothing says how the object is turned; say imu=udp:PORT and send lines "w x y'
            ' z" there, or run'
            " the Loop with your own OrientationSource (dexsim.deploy.imu)"
        )
    port, sender = found.groups()
    imu = UdpImu(int(port), sender_port=int(sender) if sender else None)
    if not imu.wait(5.0):
        raise UserError(
            f'imu=udp:{port}: no orientation came within 5 s; send lines of text "w x y z" to 127.0.0.1:{port}'
        )
    assert imu.sender is not None  # kept to since its first line
    print(f"imu      lines of {imu.sender[0]}:{imu.sender[1]}; those of others are not read")
    return imu


def _recording() -> str:
    return f"out/deploy_{time.strftime('%Y-%m-%d_%H-%M-%S')}.mcap"


def _recorder(given: dict[str, str], b: Any, settings: Any, calibration: Any) -> Any:
    import yaml

    from dexsim import outputs
    from dexsim.deploy.recorder import Recorder

    where = given.get("record") or _recording()
    if where == "none":
        return None
    path = outputs.recording(where)
    sign = ",".join(f"{int(s):+d}" for s in calibration.current_sign)
    simulated = given.get("driver", "sim") == "sim" or given.get("port", "")[:4] == "fake"
    meta = {
        "source": "sim" if simulated else "real", "robot": b.hand.robot,
        "effort_is": "current_A", "effort_sign": sign,
        "tactile_unit": "count", "tactile_lsb": f"{calibration.lsb:g}",
        "tactile_axis_sign": ",".join(f"{int(s):+d}" for s in calibration.axis_sign),
        "tactile_layout": b.hand.robot, "gravity": "0 0 -9.81",
        "notes": f"deployed policy {b.manifest['policy']['sha256'][:12]}",
    }  # fmt: skip
    config = yaml.safe_dump({"deploy": dataclasses.asdict(settings), "bundle": b.manifest["versions"]}, sort_keys=False)
    return Recorder(path, b.manifest["joints"], meta, config, time.monotonic(), sensed=b.hand.sensed)


def _settings(argv: Sequence[str]) -> tuple[dict[str, str], dict[str, Any]]:
    from dexsim.deploy.loop import LoopSettings

    fields = {f.name: str(f.type) for f in dataclasses.fields(LoopSettings) if f.name != "home"}
    given = typed.settings(argv, dict.fromkeys((*OWN, *fields)))
    changes: dict[str, Any] = {}
    for key in [k for k in given if k in fields]:
        value, kind = given.pop(key), fields[key]
        if key == "command":
            changes[key] = tuple(typed.real(x) for x in value.replace(",", " ").split())
        elif "bool" in kind:
            changes[key] = typed.truth(key, value)
        else:
            changes[key] = typed.whole(key, value) if kind == "int" else typed.number(key, value, 0.0)
    return given, changes
