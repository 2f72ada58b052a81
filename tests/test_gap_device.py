"""Where hypotheses are simulated: side by side on a CPU, in one stream a joint on a GPU, and what is said without
one."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import warp as wp
from test_gap import demo, plant_run

from dexsim.actuator.columns import COLUMNS
from dexsim.errors import UserError
from dexsim.gap import command, compute
from dexsim.gap.compute import map_joints, workers
from dexsim.gap.plant import batch as plants
from dexsim.gap.plant import kernel
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX, NAMES

GPU = wp.get_cuda_device_count() > 0


@pytest.fixture(scope="module")
def guesses():
    """Return a joint's plant, windows of a second, guesses [9, R, C] of which some differ between runs, initial
    states."""
    import mujoco

    runs = [plant_run(f"r{k}", k, 4.0, {}, seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    plant = build(mujoco.MjModel.from_xml_string(demo.MODEL), runs)[0].plant
    rng = np.random.default_rng(0)
    params = np.repeat(plant.base()[None], 9, 0)
    params[:, :, INDEX["kp"]] *= rng.uniform(0.8, 1.2, (9, 1))
    params[4:, :, INDEX["backlash"]] = 0.02
    params[:, 1, INDEX["kd"]] *= 1.1
    return plant, params, 0.01 * rng.normal(size=(9, 2))


class HostLane(plants.Lane):
    """A lane without a GPU: its memory is the CPU's."""

    pinned = False

    def __init__(self, device: str):
        self.device, self.stream, self._room, self._host = "cpu", None, {}, {}


def test_the_gpus_way_of_launching_gives_the_same_numbers(guesses, monkeypatch):
    """Buffers, offsets and groups of runs of the GPU's branch, on the CPU: bit for bit the CPU's branch."""
    from contextlib import nullcontext

    plant, params, inits = guesses
    expected = plant.simulate(params, plant.windows(1.0), inits)
    monkeypatch.setattr(plants, "Lane", HostLane)
    monkeypatch.setattr(plants.JointPlant, "_on_cpu", lambda self, threads: False)
    monkeypatch.setattr(wp, "ScopedStream", lambda *a, **k: nullcontext())
    monkeypatch.setattr(wp, "synchronize_stream", lambda stream: None)
    monkeypatch.setattr(plants, "_LANE", plants.threading.local())
    windows = plant.windows(1.0)
    for count in (9, 3, 9):  # buffers are used again, larger and smaller
        windows.known.clear()
        q, torque = plant.simulate(params[:count], windows, inits[:count])
        assert np.array_equal(q, expected[0][:count]) and np.array_equal(torque, expected[1][:count])


@pytest.mark.skipif(not GPU, reason="needs a GPU")
def test_a_gpu_gives_what_the_cpu_gives(guesses):
    plant, params, inits = guesses
    expected = plant.simulate(params, plant.windows(1.0), inits)
    plant.device = "cuda"
    try:
        q, torque = plant.simulate(params, plant.windows(1.0), inits)
    finally:
        plant.device = "cpu"
    assert np.abs(q - expected[0]).max() < 1e-6 and np.abs(torque - expected[1]).max() < 1e-5


def test_joints_side_by_side_come_back_in_order(monkeypatch):
    import threading

    seen, meet = [], threading.Barrier(3, timeout=20)

    def work(k: int, tell) -> int:
        meet.wait()  # passes only where three run at once
        tell("effect 1")
        return k * k

    names = ["a", "b", "c"]
    assert map_joints(names, work, "cuda", lambda *x: seen.append(x)) == [0, 1, 4]
    assert seen[-1] == (3, 3, "") and sorted({x[2] for x in seen[:-1]}) == names
    done = [x[0] for x in seen]
    # each begins, and tells what it is at
    assert done == sorted(done) and len(seen) == 7 and all(0 <= d <= 2 for d in done[:-1])
    with pytest.raises(ZeroDivisionError):
        map_joints(names, lambda k, tell: 1 // 0, "cuda")
    for given, cores in (("1", 1), ("4", 4), ("64", compute.MOST_CPU)):
        monkeypatch.setenv("OMP_NUM_THREADS", given)
        assert workers("cpu", 20) == cores
    assert workers("cpu", 1) == 1 and workers("cuda", 20) == compute.MOST_GPU


def test_without_such_a_gpu_the_cpu_is_used_and_said(monkeypatch, capsys):
    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 0)
    assert command.available("cuda") == "cpu" and "no such GPU" in capsys.readouterr().out
    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 2)
    assert (
        command.available("cuda:1") == "cuda:1"
        and command.available("cuda") == "cuda:0"
        and not capsys.readouterr().out
    )
    assert command.available("cuda:2") == "cpu" and "it has 2" in capsys.readouterr().out
    with pytest.raises(UserError, match="cuda:0"):
        command.available("cuda:x")


def test_a_launch_in_parts_gives_the_same_numbers(guesses, monkeypatch):
    """Cut between windows or between guesses, whatever their number: each is simulated once, bit for bit as in one
    launch."""
    plant, params, inits = guesses
    monkeypatch.setattr(compute, "WORTH", 1)
    monkeypatch.setattr(compute, "cores", lambda: 1)
    expected = {length: plant.simulate(params, plant.windows(length), inits) for length in (1.0, None)}
    for cores in (2, 3, 5):
        monkeypatch.setattr(compute, "cores", lambda cores=cores: cores)
        for length, (q, torque) in expected.items():
            windows = plant.windows(length)
            for count in (9, 2, 1):
                windows.known.clear()
                got = plant.simulate(params[:count], windows, inits[:count])
                assert np.array_equal(got[0], q[:count]) and np.array_equal(got[1], torque[:count])
    steps = np.array([100, 100, 400])
    for cores in (1, 2, 3, 8):
        monkeypatch.setattr(compute, "cores", lambda cores=cores: cores)
        for guesses_ in (1, 2, 7):
            done = np.zeros((3, guesses_), int)
            parts = compute.parts(steps, guesses_)
            for w, g in parts:
                done[w, g] += 1
            assert (done == 1).all() and len(parts) <= cores
    begun: list[int] = []  # in another's launch on six of the eight cores, two are free
    compute.run(lambda *part: begun.append(len(compute.parts(steps, 8))), [(slice(0, 3), slice(0, 1))] * 6)
    assert begun == [2] * 6 and len(compute.parts(steps, 8)) == 8


def test_guesses_side_by_side_are_what_each_is_alone(guesses, monkeypatch):
    """All columns that such guesses may have, drawn at random; some have a play, one a ripple
    beside a bias and is not of them."""
    plant, params, _ = guesses
    rng, many = np.random.default_rng(3), np.repeat(params[:1], 31, 0)
    series, plant = plant.series.copy(), copy.copy(plant)
    series[:, ~series.any(0)] = 0.1 * rng.normal(size=(len(series), 1))  # of joints that pull, of what hangs on it
    plant.set_series(series)
    servo = {c.name: c for c in COLUMNS}
    for k in kernel.USUAL:
        name, value = NAMES[k], many[:, :, k]
        away = 0.02 if name not in servo else min(servo[name].usual, servo[name].high - servo[name].neutral)
        shift = rng.uniform(0, 1, (31, 1)) * (0.5 * value if value.any() else away)
        many[:, :, k] = value + (shift if np.isfinite(shift).all() and (value < 1e8).all() else 0.0)
    many[10:20, :, INDEX["backlash"]] = 0.02
    many[14:20, :, INDEX["softness"]] = 0.05
    many[14:20, :, INDEX["rebound"]] = 0.1
    many[12, :, INDEX["linkage"]] = 0.1
    many[7, :, INDEX["torque_ripple"]] = 0.1
    pulled = ("linkage", "reaction", "own_payload", "com_out", "com_across", "coupling_from")
    for k, name in enumerate(pulled, 21):
        many[21 : k + 1, :, INDEX[name]] = 2.0 if name == "coupling_from" else 0.1
    called = {"stribeck_peak": 0.1, "torque_ripple": 0.1, "lag_stages": 2.0, "thinning_friction": 0.1}
    many[27:, :, INDEX["bias"]], many[27:, :, INDEX["ripple_per_turn"]] = 0.0, 9.0
    for k, (name, value) in enumerate(called.items(), 28):
        many[27:k, :, INDEX[name]] = value
    many[[15, 16, 22, 23, 24, 28, 29], :, INDEX["speed_feedforward"]] = 0.05 * rng.uniform(1, 2, (7, 1))
    many[[16, 24, 25, 29], :, INDEX["acceleration_feedforward"]] = 0.002
    inits = 0.01 * rng.normal(size=(31, 2))
    vectors = {columns: which.tolist() for which, columns in plant._side_by_side(many[:, 0])}
    assert vectors[kernel.TWO] == [*range(10, 18)] and vectors[kernel.USUAL] == [*range(7), 8]
    assert vectors[kernel.MORE] == [9, *range(20, 27)] and vectors[kernel.CALLED] == [*range(27, 31)]
    for length in (1.0, None):
        at_once = plant.simulate(many, plant.windows(length), inits)
        with monkeypatch.context() as m:
            m.setattr(plants, "SIDE_BY_SIDE", False)
            alone = plant.simulate(many, plant.windows(length), inits)
        assert np.ptp(alone[0], axis=0).max() > 1e-3
        assert all(np.abs(a - b).max() < 1e-9 for a, b in zip(at_once, alone, strict=True))


def test_a_fault_in_a_part_is_not_lost(monkeypatch):
    def work(windows: slice, guesses: slice) -> None:
        if guesses.start:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        compute.run(work, [(slice(0, 1), slice(0, 1)), (slice(0, 1), slice(1, 2))])


def test_what_was_simulated_is_known_and_nothing_else_is(guesses, monkeypatch):
    plant, params, inits = guesses
    windows = plant.windows(1.0)
    launched: list[int] = []
    simulated = plants.JointPlant._simulated

    class Counted(plants.JointPlant):
        def _simulated(self, params, *rest):
            launched.append(len(params))
            return simulated(self, params, *rest)

    plant.__class__ = Counted
    try:
        first = plant.simulate(params[:4], windows, inits[:4])
        order = [2, 5, 0, 2, 5]
        again = plant.simulate(params[order], windows, inits[order])
        fresh = plant.simulate(params[order], plant.windows(1.0), inits[order])
        assert launched == [4, 1, 3]  # of the second only one is new, however often it is asked for
        assert all(np.array_equal(a, b) for a, b in zip(again, fresh, strict=True))
        again[0][:] = 0.0  # what was handed out is the caller's
        assert np.array_equal(plant.simulate(params[2:3], windows, inits[2:3])[0][0], first[0][2])
        del launched[:]
        plant.simulate(params[:1], windows, inits[1:2])  # another initial state,
        plant.set_series(plant.series.copy())  # or other recorded series
        plant.simulate(params[:1], windows, inits[:1])
        assert launched == [1, 1]
        del launched[:]
        monkeypatch.setattr(plants, "KNOWN", 16 * windows.n * 2)
        for k in (0, 1, 2, 2, 1, 0):
            plant.simulate(params[k : k + 1], windows, inits[k : k + 1])
        assert launched == [1, 1, 1]  # 0 is known already; of three the two latest are kept
    finally:
        plant.__class__ = plants.JointPlant
