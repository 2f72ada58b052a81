"""Servo randomization: every joint of every world draws new drive parameters at each episode (paper, "Actuator Model
Randomization"), always from the table's nominal."""

from __future__ import annotations

import torch

from dexsim.actuator.columns import INDEX, column, simulated
from dexsim.actuator.servo import Servo
from dexsim.errors import UserError
from dexsim.tasks.randomize import Sampler

RELATIVE = ("kp", "kd", "torque_limit", "no_load_speed", "efficiency", "coulomb_friction", "viscous_friction")
"""Columns whose range multiplies the nominal; the range of every other column is added to it."""


class ServoRandomizer:
    """Draws servo parameters [N, J, C] where a mask holds.

    A column that the servo's file states with an interval (a fit: {value, low, high}) is drawn from that interval;
    otherwise `randomize.servo.<column>` says how: a factor for the columns in RELATIVE, an addition for the others.
    """

    def __init__(self, servo: Servo, sampler: Sampler):
        self.servo, self.sampler = servo, sampler
        low, high = servo.table.bounds(servo.joints)
        unknown = servo.table.unknown(servo.joints)
        dev, dtype = servo.params.device, servo.params.dtype
        fitted = torch.as_tensor((low < high) & ~unknown, device=dev)
        self.low = torch.where(fitted, torch.as_tensor(low, device=dev, dtype=dtype), servo.nominal)
        self.high = torch.where(fitted, torch.as_tensor(high, device=dev, dtype=dtype), servo.nominal)
        self.fitted = fitted
        self.simulated = torch.as_tensor(simulated(servo.features), device=dev)
        self.columns = [name.removeprefix("servo.") for name in sampler.ranges if name.startswith("servo.")]
        for name in self.columns:
            self._check(name)

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
        if name == "delay" and self.servo.control_period:
            top = min(top, (self.servo.queue - 3) * self.servo.control_period)  # targets older than that are forgotten
        if least < col.low - 1e-9 or most > top + 1e-9:
            raise UserError(
                f"randomize.servo.{name}=[{low:g}, {high:g}] {how} the nominal gives {least:g} to {most:g} {col.unit}: "
                f"must lie in [{col.low:g}, {top:g}]"
            )

    def draw(self, mask: torch.Tensor) -> None:
        """New parameters in the worlds that mask [N] selects; others keep theirs."""
        s, J = self.servo, self.servo.params.shape[1]
        new = s.nominal.expand_as(s.params).clone()
        for name in self.columns:
            c = INDEX[name]
            r = self.sampler.draw(f"servo.{name}", J).to(new.dtype)
            new[..., c] = new[..., c] * r if name in RELATIVE else new[..., c] + r
        u = torch.zeros_like(new)
        u[..., self.simulated] = self.sampler.uniform(J, len(self.simulated)).to(new.dtype)
        # infinite bounds (an absent limit) have no width: their product with u would be NaN
        width = torch.where(self.fitted, self.high - self.low, torch.zeros_like(self.low))
        new = torch.where(self.fitted, self.low + u * width, new)
        s.params.copy_(torch.where(mask[:, None, None], new, s.params))
