"""A warp as one: 32 lanes that exchange values without a barrier.

On CUDA the exchanges are shuffles. On the CPU they go through memory, one barrier before and after, in blocks of one
warp (`wp.config.enable_cpu_blocks`, block_dim=32): slow, for tests of kernels that use them. All 32 lanes must take
part in every call.
"""

from __future__ import annotations

import warp as wp

LANES = wp.constant(32)

_EXCHANGE = """
#if defined(__CUDA_ARCH__)
    return {cuda};
#else
    static {kind} wp_lane_values[WP_TILE_BLOCK_DIM];
    wp_lane_values[WP_TILE_THREAD_IDX] = {value};
    WP_TILE_SYNC();
    {cpu}
    WP_TILE_SYNC();
    return out;
#endif
"""

_XOR = _EXCHANGE.format(
    cuda="__shfl_xor_sync(0xffffffffu, v, mask)",
    kind="float",
    value="v",
    cpu="const float out = wp_lane_values[WP_TILE_THREAD_IDX ^ mask];",
)
_FROM = _EXCHANGE.format(
    cuda="__shfl_sync(0xffffffffu, v, lane)",
    kind="float",
    value="v",
    cpu="const float out = wp_lane_values[(WP_TILE_THREAD_IDX & ~31) + lane];",
)
_BALLOT = _EXCHANGE.format(
    cuda="(int)__ballot_sync(0xffffffffu, yes)",
    kind="bool",
    value="yes",
    cpu="int out = 0; for (int k = 0; k < 32; ++k) out |= (int)(wp_lane_values[(WP_TILE_THREAD_IDX & ~31) + k]) << k;",
)


@wp.func_native(_XOR)
def lane_xor(v: float, mask: int) -> float:  # type: ignore[empty-body]
    """Return the value of the lane whose number differs by the bits of `mask`."""
    ...


@wp.func_native(_FROM)
def lane_from(v: float, lane: int) -> float:  # type: ignore[empty-body]
    """Return the value of one lane."""
    ...


@wp.func_native(_BALLOT)
def lane_ballot(yes: bool) -> int:  # type: ignore[empty-body]
    """Return bit k: whether lane k says yes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ffs(bits) - 1;
#endif
""")
def lowest_bit(bits: int) -> int:  # type: ignore[empty-body]
    """Number of the lowest bit that is set."""
    ...


@wp.func
def lanes_min(v: float, width: int):
    """Return the least value of each `width` lanes (8, 16 or 32), in all of them."""
    for k in range(5):
        if (1 << k) < width:
            v = wp.min(v, lane_xor(v, 1 << k))
    return v


@wp.func
def lanes_sum(v: float, width: int):
    """Return the sum of each `width` lanes, in all of them."""
    for k in range(5):
        if (1 << k) < width:
            v += lane_xor(v, 1 << k)
    return v


@wp.func
def lanes_sum4(v: wp.vec4, lane: int, width: int):
    """Return the sum of each `width` lanes, in all of them; half the shuffles of four sums.

    Two halvings leave each lane one component, summed over 4 lanes; exchanges complete it; every quarter's first lane
    then holds one component.
    """
    quarter = width // 4
    upper = (lane & (2 * quarter)) != 0
    a = wp.where(upper, v[2], v[0]) + lane_xor(wp.where(upper, v[0], v[2]), 2 * quarter)
    b = wp.where(upper, v[3], v[1]) + lane_xor(wp.where(upper, v[1], v[3]), 2 * quarter)
    odd = (lane & quarter) != 0
    c = lanes_sum(wp.where(odd, b, a) + lane_xor(wp.where(odd, a, b), quarter), quarter)
    at = lane & (LANES - width)
    return wp.vec4(
        lane_from(c, at), lane_from(c, at + quarter), lane_from(c, at + 2 * quarter), lane_from(c, at + 3 * quarter)
    )
