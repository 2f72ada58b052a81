"""Physics without its servo, driven all the same: what the servo wrote before each physics step, recorded and
played."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache

import warp as wp


class Tape:
    """`length` physics steps of the torques, damping and friction that a servo writes, kept on the device.

    `record` and `play` stand in for `Servo.before_each` in `Engine.step`; past the end, the last step is repeated.
    """

    def __init__(self, engine, servo, length: int):
        self.engine, self._drive = engine, servo.before_each
        with wp.ScopedDevice(engine.device):
            self._tape = wp.zeros((length, 3, engine.n, engine.mjm.nv), dtype=engine.real)
            self._at = wp.zeros(1, dtype=int)
        self._copy, self._advance = _kernels(engine.real)
        fields = (engine.wp_field("dof_damping"), engine.wp_field("dof_frictionloss"))
        self._args = [self._at, self._tape, engine.wp.qfrc_applied, *fields]

    def rewind(self) -> None:
        """Go on from the first step."""
        wp.to_torch(self._at).zero_()

    def record(self) -> None:
        """Run the servo and keep what it wrote."""
        self._drive()
        self._launch(False)

    def play(self) -> None:
        """Write what the servo wrote then."""
        self._launch(True)

    def _launch(self, playing: bool) -> None:
        e = self.engine
        wp.launch(self._copy, dim=(e.n, e.mjm.nv), inputs=[playing, *self._args], device=e.device)
        wp.launch(self._advance, dim=1, inputs=[self._at], device=e.device)


@cache
def _kernels(real):
    """(copy, advance) for the engine's scalar type."""

    @wp.kernel(module="unique", enable_backward=False)
    def copy(
        playing: bool,
        at: wp.array(dtype=int),
        tape: wp.array4d(dtype=real),
        applied: wp.array2d(dtype=real),
        damping: wp.array2d(dtype=real),
        friction: wp.array2d(dtype=real),
    ):
        w, d = wp.tid()
        t = wp.min(at[0], tape.shape[0] - 1)
        if playing:
            applied[w, d] = tape[t, 0, w, d]
            damping[w, d] = tape[t, 1, w, d]
            friction[w, d] = tape[t, 2, w, d]
        else:
            tape[t, 0, w, d] = applied[w, d]
            tape[t, 1, w, d] = damping[w, d]
            tape[t, 2, w, d] = friction[w, d]

    @wp.kernel(module="unique", enable_backward=False)
    def advance(at: wp.array(dtype=int)):
        at[0] = at[0] + 1

    return copy, advance
