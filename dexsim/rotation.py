"""Rotations as tensors: quaternions [..., 4] are (w, x, y, z), unit; matrices [..., 3, 3] act on columns."""

from __future__ import annotations

from functools import cache

import torch

# What of a quaternion's products (q_i q_j is number 4 i + j) an entry of its rotation matrix is the sum of.
_PRODUCTS = ((10, 15), (6, 3), (7, 2), (6, 3), (5, 15), (11, 1), (7, 2), (11, 1), (5, 10))
_FACTORS = ((-2, -2), (2, -2), (2, 2), (2, 2), (-2, -2), (2, -2), (2, -2), (2, 2), (-2, -2))


@cache
def _tables(device: torch.device, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    with torch.inference_mode(False):  # they outlive whatever rollout comes first
        places = torch.tensor([0, 1, 2, 3, 1, 0, 3, 2, 2, 3, 0, 1, 3, 2, 1, 0], device=device)
        signs = torch.tensor([1, -1, -1, -1, 1, 1, -1, 1, 1, 1, 1, -1, 1, -1, 1, 1], dtype=dtype, device=device)
        products = torch.tensor(_PRODUCTS, device=device).flatten()
        factors = torch.tensor(_FACTORS, dtype=dtype, device=device)
        identity = torch.eye(4, dtype=dtype, device=device)[0]
        one = torch.eye(3, dtype=dtype, device=device).flatten()
        return places, signs, products, factors, one, identity, 2 * identity - 1


def _multiply_in_few(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """`multiply` in five kernels instead of thirty: on a GPU, what costs is their number."""
    places, signs, *_ = _tables(a.device, a.dtype)
    return ((a.index_select(-1, places) * signs).unflatten(-1, (4, 4)) * b[..., None, :]).sum(-1)


def _to_matrix_in_few(q: torch.Tensor) -> torch.Tensor:
    """Return `to_matrix` in five kernels instead of forty."""
    _, _, products, factors, one, *_ = _tables(q.device, q.dtype)
    all_of_them = (q[..., :, None] * q[..., None, :]).flatten(-2)
    terms = all_of_them.index_select(-1, products).unflatten(-1, (9, 2))
    return ((terms * factors).sum(-1) + one).unflatten(-1, (3, 3))


def multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Multiply quaternions (Hamilton product a b): first b, then a."""
    if a.is_cuda and a.dtype == b.dtype:
        return _multiply_in_few(a, b)
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ], -1)  # fmt: skip


def about(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Return rotation by angle [...] rad about unit axis [..., 3]."""
    half = (angle / 2)[..., None]
    return torch.cat([half.cos(), axis * half.sin()], -1)


def conjugate(q: torch.Tensor) -> torch.Tensor:
    """Return the inverse rotation."""
    return q * _tables(q.device, q.dtype)[-1]


def normalize(q: torch.Tensor) -> torch.Tensor:
    """Return unit quaternion along q; zero becomes the identity."""
    norm = q.norm(dim=-1, keepdim=True)
    return torch.where(norm > 1e-9, q / norm.clamp(min=1e-9), _tables(q.device, q.dtype)[-2])


def angle(q: torch.Tensor) -> torch.Tensor:
    """Return angle of the rotation [...], rad in [0, pi]; the same for q and -q. Accurate near 0, unlike arccos."""
    return 2 * torch.atan2(q[..., 1:].norm(dim=-1), q[..., 0].abs())


def error(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return angle between two orientations [...], rad in [0, pi]."""
    return angle(multiply(conjugate(a), b))


def from_vector(v: torch.Tensor) -> torch.Tensor:
    """Return rotation of the rotation vector v [..., 3], rad."""
    size = v.norm(dim=-1)
    return about(v / size.clamp(min=1e-12)[..., None], size)


def to_matrix(q: torch.Tensor) -> torch.Tensor:
    """Return rotation matrix [..., 3, 3] of a unit quaternion."""
    if q.is_cuda:
        return _to_matrix_in_few(q)
    w, x, y, z = q.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def from_matrix(m: torch.Tensor) -> torch.Tensor:
    """Return quaternion of a rotation matrix by Shepperd's method: the component of largest magnitude is positive.

    The sign therefore jumps between orientations where another component takes the lead, as it does in what sensors and
    pose estimators report: q and -q are one rotation.
    """
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x, y, z = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    four = torch.stack([  # 4 q_k q, k = w, x, y, z
        torch.stack([1 + d0 + d1 + d2, x, y, z], -1),
        torch.stack([x, 1 + d0 - d1 - d2, xy, xz], -1),
        torch.stack([y, xy, 1 - d0 + d1 - d2, yz], -1),
        torch.stack([z, xz, yz, 1 - d0 - d1 + d2], -1),
    ], -2)  # fmt: skip
    lead = four.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = four.gather(-2, lead[..., None, None].expand(*lead.shape, 1, 4))[..., 0, :]
    return normalize(row)


def six(q: torch.Tensor) -> torch.Tensor:
    """Return 6D representation [..., 6]: the matrix's first two columns, one after the other (Zhou et al., 2019)."""
    return six_of_matrix(to_matrix(q))


def six_of_matrix(m: torch.Tensor) -> torch.Tensor:
    """Return `six` of matrices [..., 3, 3]."""
    return torch.cat([m[..., :, 0], m[..., :, 1]], -1)


def matrix_of_six(six: torch.Tensor) -> torch.Tensor:
    """Return matrices [..., 3, 3] of `six_of_matrix`."""
    a, b = six[..., :3], six[..., 3:]
    return torch.stack([a, b, torch.linalg.cross(a, b)], -1)


def rotate(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Return vectors v [..., 3] turned by q."""
    u, w = q[..., 1:], q[..., :1]
    t = 2 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def upright(q: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return q with its tilt removed: the smallest turn that brings the object's own axis (+-x, +-y or +-z) nearest to
    the unit vector `axis` [..., 3] onto it, after q."""
    inside = rotate(conjugate(q), axis.expand_as(q[..., 1:]))
    lead = inside.abs().argmax(-1, keepdim=True)
    own = torch.zeros_like(inside).scatter(-1, lead, inside.gather(-1, lead).sign())
    a = rotate(q, own)
    swing = torch.cat([1 + (a * axis).sum(-1, keepdim=True), torch.linalg.cross(a, axis.expand_as(a))], -1)
    return normalize(multiply(normalize(swing), q))


def tilt(q: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return angle [...] between `axis` and the object's own axis nearest to it, rad (at most 0.955 for a cube's
    axes)."""
    inside = rotate(conjugate(q), axis.expand_as(q[..., 1:])).abs()
    return torch.arccos(inside.amax(-1).clamp(max=1.0))
