"""Signed distance to shapes on the device: negative inside, exact for primitives, trilinear on baked grids.

Points are in the shape's frame. Sizes are MuJoCo's: box (half extents), sphere (radius, -, -), capsule and cylinder
(radius, half length along z, -), grid (uniform scale, -, -).
"""

from __future__ import annotations

import warp as wp

BOX = 0
SPHERE = 1
CAPSULE = 2
CYLINDER = 3
GRID = 4
KINDS = {"box": BOX, "sphere": SPHERE, "capsule": CAPSULE, "cylinder": CYLINDER, "grid": GRID}


@wp.struct
class Shapes:
    """Shapes as flat arrays (S shapes, G grid samples); see `dexsim.tactile.shapes.ShapeSet`."""

    kind: wp.array(dtype=int)  # [S]
    dims: wp.array(dtype=wp.vec3i)  # [S] samples along x, y, z
    origin: wp.array(dtype=wp.vec3)  # [S] position of sample (0, 0, 0) [m] at scale 1
    spacing: wp.array(dtype=float)  # [S] [m] at scale 1
    offset: wp.array(dtype=int)  # [S] first cell in `data`
    # grid only, at scale 1: no point of the surface is farther from the frame's origin, or outside this box
    radius: wp.array(dtype=float)  # [S]
    middle: wp.array(dtype=wp.vec3)  # [S]
    half: wp.array(dtype=wp.vec3)  # [S]
    # [2 G] the 8 corners of each cell (dims - 1 of them along x, y, z): corners (y, z) = 00, 01, 10, 11 at the lower
    # x, then at the upper. One sector of 32 bytes a point instead of four, at eight times the memory; 32-bit flat
    # indices, since 64-bit strides of an N-d array cost more than the interpolation itself.
    data: wp.array(dtype=wp.vec4)


@wp.func
def sd_box(q: wp.vec3, half: wp.vec3):
    x = wp.abs(q[0]) - half[0]
    y = wp.abs(q[1]) - half[1]
    z = wp.abs(q[2]) - half[2]
    outside = wp.length(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(z, 0.0)))
    return outside + wp.min(wp.max(x, wp.max(y, z)), 0.0)


@wp.func
def sd_sphere(q: wp.vec3, radius: float):
    return wp.length(q) - radius


@wp.func
def sd_capsule(q: wp.vec3, radius: float, half: float):
    z = q[2] - wp.clamp(q[2], -half, half)
    return wp.sqrt(q[0] * q[0] + q[1] * q[1] + z * z) - radius


@wp.func
def sd_cylinder(q: wp.vec3, radius: float, half: float):
    r = wp.sqrt(q[0] * q[0] + q[1] * q[1]) - radius
    z = wp.abs(q[2]) - half
    ro = wp.max(r, 0.0)
    zo = wp.max(z, 0.0)
    return wp.sqrt(ro * ro + zo * zo) + wp.min(wp.max(r, z), 0.0)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(data.data) + i);
    return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
    return data.data[i];
#endif
""")
def load4(data: wp.array(dtype=wp.vec4), i: int) -> wp.vec4:
    """Load data[i] in one 16-byte load."""
    ...


@wp.func
def sd_cells(
    data: wp.array(dtype=wp.vec4), offset: int, n: wp.vec3i, origin: wp.vec3, h: float, scale: float, q: wp.vec3
):
    """Read a grid: trilinear inside it. Outside: sqrt(gap^2 + v^2), gap the distance to the grid's box and v the value
    at the nearest point c of it. That is a lower bound of the true distance for any shape inside the box (for k in the
    box, |q - k|^2 >= |q - c|^2 + |c - k|^2), positive and continuous."""
    # in cells; the reciprocals are the same for all points
    g = q * (1.0 / (scale * h)) - origin * (1.0 / h)
    x = wp.clamp(g[0], 0.0, float(n[0] - 1))
    y = wp.clamp(g[1], 0.0, float(n[1] - 1))
    z = wp.clamp(g[2], 0.0, float(n[2] - 1))
    ix = wp.min(int(x), n[0] - 2)
    iy = wp.min(int(y), n[1] - 2)
    iz = wp.min(int(z), n[2] - 2)
    fx = x - float(ix)
    fy = y - float(iy)
    fz = z - float(iz)
    k = 2 * (offset + (ix * (n[1] - 1) + iy) * (n[2] - 1) + iz)
    a = load4(data, k)
    b = load4(data, k + 1)
    # along x, then y, then z
    c00 = a[0] + fx * (b[0] - a[0])
    c01 = a[1] + fx * (b[1] - a[1])
    c10 = a[2] + fx * (b[2] - a[2])
    c11 = a[3] + fx * (b[3] - a[3])
    c0 = c00 + fy * (c10 - c00)
    c1 = c01 + fy * (c11 - c01)
    v = scale * (c0 + fz * (c1 - c0))
    gx = g[0] - x
    gy = g[1] - y
    gz = g[2] - z
    gap = gx * gx + gy * gy + gz * gz
    out = wp.max(v, 0.0)
    return wp.where(gap > 0.0, wp.sqrt(gap * (scale * h) * (scale * h) + out * out), v)


@wp.func
def sd_grid(s: Shapes, i: int, scale: float, q: wp.vec3):
    """Return the signed distance [m] of q to grid shape i at this scale."""
    return sd_cells(s.data, s.offset[i], s.dims[i], s.origin[i], s.spacing[i], scale, q)


@wp.func
def primitive(kind: int, size: wp.vec3, q: wp.vec3):
    """Return the signed distance [m] of q to a primitive of this size."""
    d = float(0.0)
    if kind == wp.static(BOX):
        d = sd_box(q, size)
    elif kind == wp.static(SPHERE):
        d = sd_sphere(q, size[0])
    elif kind == wp.static(CAPSULE):
        d = sd_capsule(q, size[0], size[1])
    else:
        d = sd_cylinder(q, size[0], size[1])
    return d


@wp.func
def distance(s: Shapes, i: int, size: wp.vec3, q: wp.vec3):
    """Return the signed distance [m] of q to shape i of the set, at this world's size."""
    d = float(0.0)
    if s.kind[i] == wp.static(GRID):
        d = sd_grid(s, i, size[0], q)
    else:
        d = primitive(s.kind[i], size, q)
    return d


@wp.func
def bound_radius(s: Shapes, i: int, size: wp.vec3):
    """Return the radius [m] of a sphere about the frame's origin that holds the shape."""
    kind = s.kind[i]
    r = float(0.0)
    if kind == wp.static(BOX):
        r = wp.length(size)
    elif kind == wp.static(SPHERE):
        r = size[0]
    elif kind == wp.static(CAPSULE):
        r = size[0] + size[1]
    elif kind == wp.static(CYLINDER):
        r = wp.sqrt(size[0] * size[0] + size[1] * size[1])
    else:
        r = size[0] * s.radius[i]
    return r


@wp.func
def boxes_gap(a: wp.mat33, b: wp.vec3, middle: wp.vec3, half: wp.vec3, other_middle: wp.vec3, other_half: wp.vec3):
    """Return how far [m] a face of one of two boxes separates them, at most; negative where none does. The first box's
    frame has rotation a and origin b in the second's. No point of one is nearer to the other."""
    d = a * middle + b - other_middle
    e = wp.transpose(a) * d
    gap = float(-1.0e9)
    for k in range(3):
        reach = wp.abs(a[k, 0]) * half[0] + wp.abs(a[k, 1]) * half[1] + wp.abs(a[k, 2]) * half[2]
        gap = wp.max(gap, wp.abs(d[k]) - other_half[k] - reach)
        reach = wp.abs(a[0, k]) * other_half[0] + wp.abs(a[1, k]) * other_half[1] + wp.abs(a[2, k]) * other_half[2]
        gap = wp.max(gap, wp.abs(e[k]) - half[k] - reach)
    return gap


@wp.func
def in_box(q: wp.vec3, middle: wp.vec3, half: wp.vec3):
    d = q - middle
    return wp.abs(d[0]) <= half[0] and wp.abs(d[1]) <= half[1] and wp.abs(d[2]) <= half[2]


@wp.func
def normal(s: Shapes, i: int, size: wp.vec3, q: wp.vec3):
    """Return the outward unit normal at the surface point nearest to q: the gradient of the distance, by central
    differences of 1e-3 of the size or a grid's spacing. Exact but at edges, where the nearest point is not one. For
    inspection and tests: no force needs it, since each taxel presses along its own normal."""
    e = 1.0e-5
    if s.kind[i] == wp.static(GRID):
        e = 0.5 * s.spacing[i] * size[0]
    x = distance(s, i, size, q + wp.vec3(e, 0.0, 0.0)) - distance(s, i, size, q - wp.vec3(e, 0.0, 0.0))
    y = distance(s, i, size, q + wp.vec3(0.0, e, 0.0)) - distance(s, i, size, q - wp.vec3(0.0, e, 0.0))
    z = distance(s, i, size, q + wp.vec3(0.0, 0.0, e)) - distance(s, i, size, q - wp.vec3(0.0, 0.0, e))
    return wp.normalize(wp.vec3(x, y, z))
