"""Messages decoded all at once: to the last bit what they are one after another, of whole and of damaged files."""

from __future__ import annotations

import struct
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import recordings
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import Writer as McapWriter

from dexsim.recording import cdr, decode, read, samples, write
from dexsim.recording.audit_values import quantum, repeats
from dexsim.recording.schema import IMU_TYPE, JOINT_STATE, MULTI_ARRAY, POSE, WRENCH

DEFINITIONS = {kind: cdr.definition(kind) for kind in (IMU_TYPE, JOINT_STATE, MULTI_ARRAY, POSE, WRENCH)}
NAMES = ("one", "two", "three")
STAMPS = [1_700_000_000_123_456_789 + 10_000_000 * i for i in range(40)]


def bits(x):
    """Return the anything that a reader or a recording holds, its numbers as bytes."""
    if isinstance(x, np.ndarray):
        return x.dtype.str, x.shape, x.tobytes()
    if isinstance(x, float):
        return np.float64(x).tobytes()
    if isinstance(x, decode.JointSample):
        return [bits(getattr(x, k)) for k in ("names", "position", "velocity", "effort", "stamp")]
    if is_dataclass(x):
        return [(f.name, bits(getattr(x, f.name))) for f in fields(x) if f.name != "hand"]
    if isinstance(x, dict):
        return [(k, bits(v)) for k, v in x.items()]
    return [bits(v) for v in x] if isinstance(x, (list, tuple)) else repr(x)


def made(kind):
    """Return the forty messages of a type that we write, and what reads them."""
    x = np.random.default_rng(0).standard_normal((len(STAMPS), 37))
    x[3, 2], x[7] = np.nan, 0.0
    channel = Channel(id=1, schema_id=1, topic="/any", message_encoding="cdr", metadata={})
    schema = Schema(id=1, name=kind, encoding="ros2msg", data=DEFINITIONS[kind].encode())
    each = {
        JOINT_STATE: lambda t, v: cdr.joint_state(t, NAMES, v[:3], None, v[3:6]),
        MULTI_ARRAY: lambda t, v: cdr.multi_array(v[:12].reshape(3, 4), ("row", "column")),
        WRENCH: lambda t, v: cdr.wrench(t, "palm", v[:6]),
        POSE: lambda t, v: cdr.pose(t, "palm", v[:7]),
        IMU_TYPE: lambda t, v: cdr.imu(t, "object", v[:10]),
    }[kind]
    reader = {
        JOINT_STATE: lambda: decode.joint_reader(channel, schema, ""),
        MULTI_ARRAY: lambda: decode.array_reader(channel, schema, ""),
        WRENCH: lambda: decode.vector_reader(channel, schema, "", "wrench"),
        POSE: lambda: decode.vector_reader(channel, schema, "", "pose"),
        IMU_TYPE: lambda: decode.vector_reader(channel, schema, "", "imu"),
    }[kind]()
    return [each(t, v) for t, v in zip(STAMPS, x, strict=True)], reader


@pytest.mark.parametrize("kind", sorted(DEFINITIONS))
def test_all_at_once_is_one_after_another(kind):
    messages, reader = made(kind)
    if kind != MULTI_ARRAY:
        messages[5] = messages[5][:4] + bytes(8) + messages[5][12:]  # no stamp
    rows = reader.together(messages)
    assert rows is not None and len(rows) == len(messages)
    one = [reader(m) for m in messages]
    assert bits(list(rows)) == bits(one) == bits([rows[i] for i in range(len(rows))])


@pytest.mark.parametrize("kind", sorted(DEFINITIONS))
def test_any_byte_that_differs_is_a_number_s_or_none_is_decoded_at_once(kind):
    messages, reader = made(kind)
    at_once = 0
    for k in range(len(messages[0])):
        damaged = bytearray(messages[9])
        damaged[k] ^= 0x15
        some = [*messages[:9], bytes(damaged), *messages[10:12]]
        rows = reader.together(some)
        if rows is not None:
            at_once += 1
            assert bits(list(rows)) == bits([reader(m) for m in some]), k
    numbers = {JOINT_STATE: 8 + 6 * 8, MULTI_ARRAY: 12 * 4, WRENCH: 8 + 6 * 8, POSE: 8 + 7 * 8, IMU_TYPE: 8 + 37 * 8}
    assert at_once == numbers[kind]


@pytest.mark.parametrize("kind", sorted(DEFINITIONS))
def test_messages_of_several_layouts_are_not_decoded_at_once(kind):
    messages, reader = made(kind)
    assert reader.together([messages[0][:-8], *messages[1:]]) is None
    assert reader.together([*messages[:-1], messages[-1][:-1]]) is None
    assert reader.together([*messages[:-1], messages[-1] + b"\0"]) is None
    assert reader.together([m[:20] for m in messages]) is None
    assert reader.together([b"\0\0" + m[2:] for m in messages]) is None  # said to be of big endian
    assert reader.together(messages[:1]) is None and reader.together([]) is None


def test_a_count_that_reaches_beyond_the_message():
    messages, reader = made(JOINT_STATE)
    at = messages[0].index(struct.pack("<I", 3), 60)  # of positions
    some = [m[:at] + struct.pack("<I", 3000) + m[at + 4 :] for m in messages]
    assert reader.together(some) is None
    with pytest.raises(Exception, match=".+"):
        reader(some[0])


def again(source, path, edit):
    """Return a recording with its messages (topic, log time, bytes) edited, in the order that `edit` gives them."""
    with open(source, "rb") as file:
        reader = make_reader(file)
        found = [(s, c, m) for s, c, m in reader.iter_messages(log_time_order=False)]
        metadata = list(reader.iter_metadata())
    w = McapWriter(str(path))
    w.start()
    for m in metadata:
        w.add_metadata(m.name, m.metadata)
    ids = {c.id: w.register_channel(c.topic, c.message_encoding, w.register_schema(s.name, s.encoding, s.data))
           for s, c, _ in found}  # fmt: skip
    for number, t, data in edit([(c.id, m.log_time, m.data) for _, c, m in found]):
        w.add_message(ids[number], t, data, t)
    w.finish()
    return path


def gap(all_):
    return [m for i, m in enumerate(all_) if not 900 < i < 1500 and i % 11]


def repeated(all_):
    return [m for i, m in enumerate(all_) for _ in range(1 + (i % 13 == 0))]


def unsorted(all_):
    return [all_[i] for i in np.argsort(np.arange(len(all_)) + np.random.default_rng(1).uniform(0, 8, len(all_)))]


def set_back(all_):
    return [(c, t - (3_000_000_000 if 1000 < i < 1600 else 0), d) for i, (c, t, d) in enumerate(all_)]


def cut_short(all_):
    return [(c, t, d[: len(d) // 2] if i % 200 == 7 else d) for i, (c, t, d) in enumerate(all_)]


def one_bit(all_):
    rng, out = np.random.default_rng(2), []
    for c, t, d in all_:
        data = bytearray(d)
        data[rng.integers(3 * len(data) // 4, len(data))] ^= 1 << rng.integers(8) if rng.random() < 0.02 else 0
        out.append((c, t, bytes(data)))
    return out


def much_later(all_):
    return [(c, t + (1 << 62), d) for c, t, d in all_]


@pytest.mark.slow
@pytest.mark.parametrize("edit", [list, gap, repeated, unsorted, set_back, cut_short, one_bit, much_later])
def test_a_recording_is_the_same_to_the_last_bit(edit, tmp_path, monkeypatch):
    whole = recordings.signal(4.0, recordings.HAND[:4], tactile=True)
    whole.states.effort.value[30:33, 1] = np.nan
    write(tmp_path / "whole.mcap", whole)
    path = again(tmp_path / "whole.mcap", tmp_path / "edited.mcap", edit)
    at_once = read(path)
    monkeypatch.setattr(samples.Reader, "together", lambda self, messages: None)
    assert bits(at_once) == bits(read(path))


def plainly_repeated(t, x):
    """`repeats` as one would write it down: a loop over the stretches of equal samples."""
    out, dx = np.zeros(len(x), bool), np.diff(x)
    step = max(quantum(x), 1e-9)
    for a in np.flatnonzero((dx == 0) & (np.append(1.0, dx[:-1]) != 0)):
        b = a + 1
        while b < len(dx) and dx[b] == 0:
            b += 1
        if a < 2 or b + 3 >= len(x) or not np.isfinite(x[a - 2 : b + 4]).all():
            continue
        before = (x[a] - x[a - 2]) / max(t[a] - t[a - 2], 1e-9)
        after = (x[b + 3] - x[b + 1]) / max(t[b + 3] - t[b + 1], 1e-9)
        if np.any(np.array([dx[a - 2], dx[a - 1], dx[b + 1], dx[b + 2]]) * dx[b] < 0):
            continue
        slow = min(abs(before), abs(after))
        if before * after <= 0 or max(abs(before), abs(after)) > 2 * slow or slow * (t[b] - t[a]) < 3 * step:
            continue
        jump = (x[b + 1] - x[b]) * np.sign(before)
        way = 0.5 * (abs(before) + abs(after)) * (t[b + 1] - t[a])
        if 0.7 * way < jump < 1.4 * way:
            out[a + 1 : b + 1] = True
    return out


def test_repeats_are_those_of_a_plain_loop():
    rng, seen = np.random.default_rng(0), 0
    for k in range(200):
        t = np.cumsum(rng.choice([0.01, 0.011, 0.0], int(rng.integers(1, 400)), p=[0.8, 0.18, 0.02]))
        x = np.sin(rng.uniform(0.5, 6) * t) + rng.choice([0.0, 1e-4]) * rng.standard_normal(len(t))
        x = np.round(x / 0.002) * 0.002 if k % 3 == 0 else x
        for i in np.flatnonzero(rng.random(len(x)) < 0.15):
            x[i] = x[i - 1] if i else x[i]
        x[rng.random(len(x)) < (0.01 if k % 4 == 0 else 0)] = np.nan
        found = repeats(t, x)
        seen += int(found.sum())
        assert np.array_equal(found, plainly_repeated(t, x)), k
    assert seen > 100
