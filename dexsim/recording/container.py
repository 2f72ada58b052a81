"""The records of an MCAP file, whatever state it is in: finished, cut off by a kill, or damaged in the middle."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream

from dexsim.errors import UserError

MAGIC = b"\x89MCAP0\r\n"
_HEAD = 9  # opcode and length
_BROKEN = (
    McapError,
    CRCValidationError,
    ValueError,
    struct.error,
    EOFError,
    zstandard.ZstdError,
    RuntimeError,
    MemoryError,
)


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
        """The channel of a message; None where its record is lost."""
        return self.channels.get(message.channel_id)


def open_container(path: Path) -> Container:
    """Read every record that can be read. Raises UserError for what is not an MCAP file at all."""
    try:
        with open(path, "rb") as file:
            size = path.stat().st_size
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
    except FileNotFoundError:
        raise UserError(f"recording {path} does not exist") from None
    except OSError as error:
        raise UserError(f"recording {path} cannot be read: {error.strerror}") from None
    if data[: len(MAGIC)] != MAGIC:
        what = "empty" if not size else "not an MCAP file"
        hint = (
            "; convert it with `ros2 bag convert`, or record with `ros2 bag record -s mcap`"
            if data[:6] == b"SQLite"
            else "; numbers in named columns are read from .csv, .tsv and .npz"
        )
        raise UserError(f"recording {path} is {what} (it must start with the MCAP magic){hint}")
    out = Container(path)
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
    return out


def _records(data: mmap.mmap | bytes, out: Container) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset of the body, length) of each record; the last may reach beyond the end of a truncated file."""
    at, size = len(MAGIC), len(data)
    while at + _HEAD <= size:
        if data[at : at + len(MAGIC)] == MAGIC and size - at == len(MAGIC):
            return
        opcode, length = struct.unpack_from("<BQ", data, at)
        beyond = at + _HEAD + length > size
        if not _plausible(opcode) or (beyond and not _cut_chunk(data, at)):
            found = _resync(data, at + 1)
            lost = (found or size) - at
            if not (beyond and found is None and _plausible(opcode)):  # else simply the truncated end
                out.damage.append((None, 0, f"{lost} bytes at byte {at} are not MCAP records; skipped"))
            if found is None:
                return
            at = found
            continue
        yield opcode, at + _HEAD, length
        at += _HEAD + length


def _plausible(opcode: int) -> bool:
    return Opcode.HEADER <= opcode <= Opcode.DATA_END


def _cut_chunk(data: mmap.mmap | bytes, at: int) -> bool:
    """A chunk record at the end of the file that the file does not hold in full (rather than a damaged length)."""
    return data[at] == Opcode.CHUNK and _resync(data, at + 1) is None


def _resync(data: mmap.mmap | bytes, start: int) -> int | None:
    """The next offset at which a whole chunk record stands, followed by another record or the end of the file."""
    size = len(data)
    raw = np.frombuffer(data, dtype=np.uint8)
    for at in (np.flatnonzero(raw[start:] == int(Opcode.CHUNK)) + start).tolist():
        if at + _HEAD + 32 > size:
            return None
        length, first, last, _, _, name = struct.unpack_from("<QQQQII", data, at + 1)
        after = at + _HEAD + length
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
    except _BROKEN as error:
        out.damage.append((None, 1, f"a record (opcode {opcode}) cannot be read: {error or type(error).__name__}"))


def _chunk(body: bytes, cut: bool, out: Container) -> None:
    """The records of a chunk. One whose checksum fails is left out whole; of one cut short, what is complete is
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
            data = zstandard.ZstdDecompressor().decompressobj().decompress(packed) if kind == b"zstd" else packed
        else:
            chunk = Chunk.read(ReadDataStream(BytesIO(body)))
            span = chunk.message_start_time
            data = get_chunk_data_stream(chunk)[0].read(max(chunk.uncompressed_size, 1)) if chunk.data else b""
            if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
                raise ValueError("its checksum does not fit")
        at = 0
        while at + _HEAD <= len(data):
            opcode, length = struct.unpack_from("<BQ", data, at)
            if at + _HEAD + length > len(data):
                break
            _plain(opcode, data[at + _HEAD : at + _HEAD + length], length, out)
            at += _HEAD + length
    except _BROKEN as error:
        text = " ".join(str(error).split()) or type(error).__name__
        out.damage.append((span, 0, f"a chunk of {len(body)} bytes is lost: {text}"))
    if cut:
        kept = len(out.messages) - before
        out.damage.append((span, 0, f"the last chunk is cut off; its first {kept} messages were recovered"))
