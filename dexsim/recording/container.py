"""The records of an MCAP file, whatever state it is in: finished, cut off by a kill, or damaged in the middle; and of
what `ros2 bag record` makes of it otherwise: an SQLite file (.db3), and either packed as a whole or message by
message (zstd)."""

from __future__ import annotations

import contextlib
import mmap
import os
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from rosbags.typesys import TypesysError

from dexsim.errors import UserError
from dexsim.recording import cdr

MAGIC = b"\x89MCAP0\r\n"
SQLITE = b"SQLite format 3\0"
ZSTD = b"\x28\xb5\x2f\xfd"
PACKED = {b"\x1f\x8b": "gunzip", ZSTD: "zstd -d", b"\xfd7zXZ": "unxz", b"BZh": "bunzip2", b"PK\3\4": "unzip",
          b"7z\xbc\xaf": "7z x", b"\x04\x22\x4d\x18": "lz4 -d"}  # fmt: skip
"""How packed files begin, and what unpacks them."""
BAGS = ("*.mcap", "*.mcap.zstd", "*.db3", "*.db3.zstd")
"""What the files of a bag's folder are called."""
_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_MESSAGE = struct.Struct("<HIQQ")  # how a message's record begins: channel, sequence, log and publish time

@dataclass
class Container:
    """What one MCAP file holds. damage: (ns or None, number of messages or 0 where unknown, text) of what is lost."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: list[Message] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    damage: list[tuple[int | None, int, str]] = field(default_factory=list)

    def channel(self, message: Message) -> Channel | None:
        """Return the channel of a message; None where its record is lost."""
        return self.channels.get(message.channel_id)


def open_container(path: Path) -> Container:
    """Read every record that can be read. Raises UserError for what is not a bag's file at all."""
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            data: Any = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
    except OSError as error:
        raise UserError(f"recording {path} cannot be read: {error.strerror}") from None
    out = Container(path)
    if data[: len(ZSTD)] == ZSTD:
        try:
            data = _unzip(data)
        except Exception as error:
            raise UserError(
                f"recording {path}: compressed as a whole, and cannot be unpacked here ({error}); `zstd -d {path.name}`"
            ) from None
    if data[: len(SQLITE)] == SQLITE:
        _sqlite(data, out)
    elif data[: len(MAGIC)] == MAGIC:
        _mcap(data, len(data), out)
    else:
        what = "empty" if not size else "not an MCAP file"
        hint = (
            f"; it is a bag of ROS 1: `rosbags-convert --src {path.name} --dst {path.stem}` makes one of ROS 2"
            if data[:8] == b"#ROSBAG "
            else f"; it is packed: unpack it first, `{packed} {path.name}`"
            if (packed := next((tool for magic, tool in PACKED.items() if data[:6].startswith(magic)), ""))
            else "; numbers in named columns are read from .csv, .json, .npz and the like"
        )
        raise UserError(f"recording {path} is {what} (it must start with the MCAP magic){hint}")
    for m in out.messages:
        if m.data[: len(ZSTD)] == ZSTD:  # plain CDR begins with a zero
            try:
                m.data = _unzip(m.data)
            except Exception:
                continue  # its decoder says that it cannot be read
    return out


def _sqlite(data: Any, out: Container) -> None:
    """Return the messages of an SQLite bag. Definitions that it lacks (before ROS 2 Iron) are those of the standard
    types."""
    try:
        with contextlib.closing(sqlite3.connect(":memory:")) as db:
            db.deserialize(data)
            tables = {name for (name,) in db.execute("select name from sqlite_master where type = 'table'")}
            if not {"topics", "messages"} <= tables:
                raise UserError(f"recording {out.path}: an SQLite file without a bag's tables (topics, messages)")
            defined = {}
            if "message_definitions" in tables:
                rows = db.execute("select topic_type, encoding, encoded_message_definition from message_definitions")
                defined = {str(kind): (str(encoding), str(text)) for kind, encoding, text in rows}
            for number, topic, kind, encoding in db.execute("select id, name, type, serialization_format from topics"):
                how, text = defined.get(str(kind)) or ("ros2msg", _standard(str(kind)))
                out.schemas[number] = Schema(data=text.encode(), encoding=how, id=number, name=str(kind))
                out.channels[number] = Channel(id=number, topic=str(topic), message_encoding=str(encoding),
                                               metadata={}, schema_id=number)  # fmt: skip
            for k, (number, t, content) in enumerate(db.execute("select topic_id, timestamp, data from messages")):
                out.messages.append(Message(number, int(t), bytes(content), int(t), k))
    except (sqlite3.Error, TypeError, ValueError) as error:
        if not out.messages:
            raise UserError(f"recording {out.path}: its SQLite file cannot be read: {error}") from None
        out.damage.append((None, 0, f"its SQLite file ends in damage: {error}"))


def _standard(kind: str) -> str:
    """Return the definition of a standard message type; empty for another."""
    try:
        return cdr.definition(kind)
    except (TypesysError, KeyError, ValueError):
        return ""


def _mcap(data: mmap.mmap | bytes, size: int, out: Container) -> None:
    """Return the records of an MCAP file."""
    finished = False
    for opcode, at, length in _records(data, out):
        body = data[at : at + length]
        if opcode == Opcode.FOOTER:
            finished = True
        elif opcode == Opcode.CHUNK:
            _chunk(body, len(body) < length, out)
        elif len(body) == length:
            _plain(opcode, body, length, out)
    if not finished:
        out.damage.append(
            (None, 0, f"the file ends at byte {size} without its index: it was cut off, or its writer was killed")
        )


def _records(data: mmap.mmap | bytes, out: Container) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset of the body, length) of each record; the last may reach beyond the end of a truncated
    file."""
    at, size = len(MAGIC), len(data)
    while at + _HEAD.size <= size:
        if data[at : at + len(MAGIC)] == MAGIC and size - at == len(MAGIC):
            return
        opcode, length = _HEAD.unpack_from(data, at)
        beyond = at + _HEAD.size + length > size
        if not _plausible(opcode) or (beyond and not _cut_chunk(data, at)):
            found = _resync(data, at + 1)
            lost = (found or size) - at
            if not (beyond and found is None and _plausible(opcode)):  # else simply the truncated end
                out.damage.append((None, 0, f"{lost} bytes at byte {at} are not MCAP records; skipped"))
            if found is None:
                return
            at = found
            continue
        yield opcode, at + _HEAD.size, length
        at += _HEAD.size + length


def _plausible(opcode: int) -> bool:
    return Opcode.HEADER <= opcode <= Opcode.DATA_END


def _cut_chunk(data: mmap.mmap | bytes, at: int) -> bool:
    """Return a chunk record at the end of the file that the file does not hold in full (rather than a damaged
    length)."""
    return data[at] == Opcode.CHUNK and _resync(data, at + 1) is None


def _resync(data: mmap.mmap | bytes, start: int) -> int | None:
    """Return the next offset at which a whole chunk record stands, followed by another record or the end of the
    file."""
    size = len(data)
    raw = np.frombuffer(data, dtype=np.uint8)
    for at in (np.flatnonzero(raw[start:] == int(Opcode.CHUNK)) + start).tolist():
        if at + _HEAD.size + 32 > size:
            return None
        length, first, last, _, _, name = struct.unpack_from("<QQQQII", data, at + 1)
        after = at + _HEAD.size + length
        if length < 40 or after > size or first > last or name > 4:
            continue
        if data[at + 41 : at + 41 + name] in (b"", b"zstd", b"lz4") and (after == size or _plausible(data[after])):
            return at
    return None


def _plain(opcode: int, body: bytes, length: int, out: Container) -> None:
    stream = ReadDataStream(BytesIO(body))
    try:
        if opcode == Opcode.SCHEMA:
            record = Schema.read(stream)
            out.schemas.setdefault(record.id, record)
        elif opcode == Opcode.CHANNEL:
            record = Channel.read(stream)
            out.channels.setdefault(record.id, record)
        elif opcode == Opcode.MESSAGE:
            out.messages.append(Message.read(stream, length))
        elif opcode == Opcode.METADATA:
            out.metadata.append(Metadata.read(stream))
        elif opcode == Opcode.ATTACHMENT:
            record = Attachment.read(stream)
            out.attachments[record.name] = record.data
    except Exception as error:
        out.damage.append((None, 1, f"a record (opcode {opcode}) cannot be read: {error or type(error).__name__}"))


def _unzip(packed: Any) -> bytes:
    """Return what zstd packed, as far as it is there."""
    with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(packed) as reader:
        return b"".join(iter(lambda: reader.read(1 << 20), b""))


def _chunk(body: bytes, cut: bool, out: Container) -> None:
    """Return the records of a chunk. One whose checksum fails is left out whole; of one cut short, what is complete is
    kept."""
    before = len(out.messages)
    span = None
    try:
        if cut:
            start, _, _, _, name = struct.unpack_from("<QQQII", body)
            span = start
            kind, packed = bytes(body[32 : 32 + name]), body[40 + name :]
            if kind not in (b"zstd", b""):
                raise ValueError(f"a truncated {kind.decode('ascii', 'replace')} chunk cannot be unpacked")
            data = _unzip(packed) if kind == b"zstd" else packed
        else:
            chunk = Chunk.read(ReadDataStream(BytesIO(body)))
            span = chunk.message_start_time
            if chunk.compression == "zstd":
                data = _unzip(chunk.data)
            elif chunk.compression == "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data) if chunk.data else b""
            elif chunk.compression == "":
                data = chunk.data
            else:
                raise ValueError(f"its compression '{chunk.compression[:20]}' is not read; zstd, lz4 and none are")
            if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
                raise ValueError("its checksum does not fit")
        at, message = 0, int(Opcode.MESSAGE)
        while at + _HEAD.size <= len(data):
            opcode, length = _HEAD.unpack_from(data, at)
            if at + _HEAD.size + length > len(data):
                break
            if opcode == message and length >= _MESSAGE.size:  # nearly all records are messages
                channel, sequence, logged, published = _MESSAGE.unpack_from(data, at + _HEAD.size)
                content = data[at + _HEAD.size + _MESSAGE.size : at + _HEAD.size + length]
                out.messages.append(Message(channel, logged, content, published, sequence))
            else:
                _plain(opcode, data[at + _HEAD.size : at + _HEAD.size + length], length, out)
            at += _HEAD.size + length
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        out.damage.append((span, 0, f"a chunk of {len(body)} bytes is lost: {text}"))
    if cut:
        usable = len(out.messages) - before
        out.damage.append((span, 0, f"the last chunk is cut off; its first {usable} messages were recovered"))
