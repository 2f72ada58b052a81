"""Servo randomization: every joint of every world draws new drive parameters at each episode (paper, "Actuator Model
Randomization"), always from the table's nominal."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from collections.abc import Sequence
from functools import cache

import torch
import warp as wp

from dexsim.actuator.columns import DELAYS, INDEX, column, simulated
from dexsim.actuator.servo import Servo
from dexsim.errors import UserError
from dexsim.tasks.randomize import Sampler

RELATIVE = ("kp", "kd", "torque_limit", "no_load_speed", "efficiency", "coulomb_friction", "viscous_friction")
"""Columns whose range multiplies the nominal; the range of every other column is added to it."""


LANES = 64
"""Threads that share a world's columns."""


@cache
def draw_kernel(real: type) -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def draw(
        mask: wp.array(dtype=wp.bool),
        drawn: wp.array3d(dtype=float),  # [D, N, J] of the ranges
        u: wp.array3d(dtype=float),  # [N, J, .] in [0, 1), of the intervals
        source: wp.array(dtype=int),  # [C] the column's place in drawn, -1: in none
        times: wp.array(dtype=wp.bool),  # [C] what is drawn is a factor
        place: wp.array(dtype=int),  # [C] the column's place in u, -1: in none
        nominal: wp.array2d(dtype=real),
        fitted: wp.array2d(dtype=wp.bool),
        low: wp.array2d(dtype=real),
        high: wp.array2d(dtype=real),
        # out
        params: wp.array3d(dtype=real),
    ):
        w, lane = wp.tid()
        if not mask[w]:
            return
        columns = params.shape[2]
        i = lane
        while i < params.shape[1] * columns:
            j = i / columns
            c = i % columns
            value = nominal[j, c]
            if source[c] >= 0:
                r = real(drawn[source[c], w, j])
                if times[c]:
                    value = value * r
                else:
                    value = value + r
            if fitted[j, c]:
                share = real(0.0)
                if place[c] >= 0:
                    share = real(u[w, j, place[c]])
                value = low[j, c] + share * (high[j, c] - low[j, c])
            params[w, j, c] = value
            i += wp.static(LANES)

    return draw


class ServoRandomizer:
    """Draws servo parameters [N, J, C] where a mask holds.

    A column that the servo's file states with an interval (a fit: {value, low, high}) is drawn from that interval;
    otherwise `randomize.servo.<column>` says how: a factor for the columns in RELATIVE, an addition for the others.
    """

    def __init__(self, servo: Servo, sampler: Sampler, exact: Sequence[str] = ()):
        """Prepare draws for each joint. exact: joints whose drives stay as the table has them."""
        wp.init()
        self.servo, self.sampler = servo, sampler
        low, high = servo.table.bounds(servo.joints)
        unknown = servo.table.unknown(servo.joints)
        dev, dtype = servo.params.device, servo.params.dtype
        fitted = torch.as_tensor((low < high) & ~unknown, device=dev)
        self.low = torch.where(fitted, torch.as_tensor(low, device=dev, dtype=dtype), servo.nominal)
        self.high = torch.where(fitted, torch.as_tensor(high, device=dev, dtype=dtype), servo.nominal)
        fitted[[servo.joints.index(name) for name in exact]] = True
        self.fitted = fitted
        self.simulated = torch.as_tensor(simulated(servo.features), device=dev)
        self.columns = [name.removeprefix("servo.") for name in sampler.ranges if name.startswith("servo.")]
        for name in self.columns:
            self._check(name)
        source, place = (torch.full((servo.params.shape[2],), -1, dtype=torch.int32) for _ in range(2))
        times = torch.zeros(len(source), dtype=torch.bool)
        for k, name in enumerate(self.columns):
            source[INDEX[name]], times[INDEX[name]] = k, name in RELATIVE
        place[self.simulated.cpu()] = torch.arange(len(self.simulated), dtype=torch.int32)
        own = (source.to(dev), times.to(dev), place.to(dev), servo.nominal, fitted, self.low, self.high, servo.params)
        self._args = [wp.from_torch(x) for x in own]
        self._kernel = draw_kernel(wp.float64 if dtype == torch.float64 else wp.float32)

    def _check(self, name: str) -> None:
        """Raise UserError unless every value that a range can give is one that the servo can have."""
        col, (low, high, _) = column(name), self.sampler.range(f"servo.{name}")
        self.servo.check_simulated(name)
        value = self.servo.nominal[:, INDEX[name]]
        value = value[torch.isfinite(value)].double()
        if len(value) == 0:
            return
        ends = torch.stack([value * low, value * high] if name in RELATIVE else [value + low, value + high])
        least, most, top = float(ends.min()), float(ends.max()), col.high
        how = "times" if name in RELATIVE else "added to"
        if name in DELAYS and self.servo.control_period:  # targets older than the queue are forgotten
            others = self.high[:, [INDEX[x] for x in DELAYS if x != name]].sum(1).max()
            top = min(top, (self.servo.queue - 3) * self.servo.control_period - float(others))
        if least < col.low - 1e-9 or most > top + 1e-9:
            raise UserError(
                f"randomize.servo.{name}=[{low:g}, {high:g}] {how} the nominal gives {least:g} to {most:g} {col.unit}: "
                f"must lie in [{col.low:g}, {top:g}]"
            )

    def saturation(self) -> torch.Tensor:
        """Return the error of position [J] rad at which any drive that may be drawn is at its limit; inf without a
        gain."""

        def ends(name: str) -> tuple[torch.Tensor, torch.Tensor]:
            c, (low, high, _) = INDEX[name], self.sampler.ranges.get(f"servo.{name}", (1.0, 1.0, False))
            given, fitted = self.servo.nominal[:, c], self.fitted[:, c]
            return torch.where(fitted, self.low[:, c], low * given), torch.where(fitted, self.high[:, c], high * given)

        return (1.0 if self.servo.table.drive == "voltage" else ends("torque_limit")[1]) / ends("kp")[0]

    def draw(self, mask: torch.Tensor) -> None:
        """Draw new parameters in the worlds that mask [N] selects; others keep theirs."""
        n, joints, columns = self.servo.params.shape
        drawn = [self.sampler.draw(f"servo.{name}", joints) for name in self.columns]
        u = self.sampler.uniform(joints, len(self.simulated))
        columns_of = torch.stack(drawn) if drawn else u[None, :, :, 0]
        wp.launch(
            self._kernel,
            dim=(n, min(LANES, joints * columns)),
            inputs=[wp.from_torch(x) for x in (mask, columns_of, u)] + self._args,
            device=str(self.servo.params.device),
        )
