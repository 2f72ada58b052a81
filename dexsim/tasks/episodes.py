"""How episodes begin in masked worlds, and how terms get to know the state: an environment beside its step loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext

import torch
import warp as wp

from dexsim import rotation
from dexsim.tasks import nan_dump, object_kernel, randomize, servos, state_kernels
from dexsim.tasks.building import Built
from dexsim.tasks.scenes import Slide
from dexsim.tasks.structs import filled


class Episodes(Built):
    """Worlds that begin anew where a mask says so; see `HandEnv`."""

    # what `Task` has: where mask [N] holds, a new episode (object, servo, state through `place`); groups of
    # observations [N, D], advance: a control step has passed (sensors with memory move on); what drives are drawn; how
    # pads are launched
    begin_episodes: Callable[[torch.Tensor], None]
    observe: Callable[..., dict[str, torch.Tensor]]
    servo_random: servos.ServoRandomizer
    feel: Callable[[], None]

    def reset_all(self) -> None:
        """Begin an episode in every world."""
        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self.reset(mask)

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes where mask [N] holds, and refresh the observations of all worlds."""
        with self._drawn_ahead("episodes"):
            self.begin_episodes(mask)
        self.engine.refresh()
        self._clear_touch(mask)
        self._episode_length.masked_fill_(mask, 0)
        self.action.masked_fill_(mask[:, None], 0.0)
        self.last_action.masked_fill_(mask[:, None], 0.0)
        self.read_state()
        self._observe_all()

    @contextmanager
    def _drawn_ahead(self, name: str) -> Iterator[None]:
        """Draw all random numbers of a part of the step at once on a GPU; evaluation draws as ever, whatever the
        device."""
        with self.sampler.drawn_ahead(name) if self.graphs and self.draws_ahead else nullcontext():
            yield

    def _observe_all(self) -> None:
        self._blind.zero_()
        with self._drawn_ahead("observations"):
            observed = self.observe(advance=True)
        for row, (group, value) in enumerate(observed.items(), 1):
            if group not in self.obs:
                self.obs[group] = torch.zeros_like(value)
            args, dim = [wp.from_torch(value), row, wp.from_torch(self._blind)], value.shape
            wp.launch(state_kernels.note_not_finite, dim=dim, inputs=args, device=self.device)
            out = wp.from_torch(self.obs[group])
            wp.launch(state_kernels.keep_finite, dim=dim, inputs=[*args, out], device=self.device)

    def place(
        self, mask: torch.Tensor, hand_q: torch.Tensor, object_pose: torch.Tensor, object_velocity: torch.Tensor,
        target: torch.Tensor | None = None, also: Mapping[int, torch.Tensor] | None = None,
    ) -> None:  # fmt: skip
        """Place, where mask holds, the hand at rest at hand_q [N, J], sent to target [N, J] (hand_q without one); the
        object at pose [N, 7] (x y z, w x y z) moving at velocity [N, 6] (linear in the palm frame, angular in the
        object's own), where it moves freely. also: values [N] of further numbers of qpos, by index (`q_of`)."""
        e, target = self.engine, hand_q if target is None else target
        # what else there is begins as the scene has it
        qpos = e.t.qpos.clone() if self._alone else self._begin_q.expand_as(e.t.qpos).clone()
        qvel = torch.zeros_like(e.t.qvel)
        at_q, at_v = self._object_at
        qpos[:, self.joint_q] = hand_q.to(qpos.dtype)
        if self.scene.free:
            qpos[:, at_q : at_q + 7] = object_pose.to(qpos.dtype)
            qvel[:, at_v : at_v + 6] = object_velocity.to(qvel.dtype)
        for index, value in (also or {}).items():
            qpos[:, index] = value.to(qpos.dtype)
        if self.hand.couplings.passive:
            qpos = self._couplings.complete(qpos)
        e.set_state(mask, qpos, qvel)
        self.servo.reset(mask, target)
        self.touch.reset(mask)
        torch.where(mask[:, None], target, self.target, out=self.target)

    def _clear_touch(self, mask: torch.Tensor) -> None:
        """Clear the touch of worlds where mask [N] holds: no force, centres at the pads' centres (poses are
        refreshed)."""
        touch, state = self.touch, self.engine.wp
        wp.launch(
            state_kernels.clear_touch,
            dim=touch.force.shape,
            inputs=[wp.from_torch(mask), state.xpos, state.xmat, *self._touch_args],
            device=self.device,
        )
        for raw in (touch.raw, touch.raw_clean, touch.raw3):
            if raw is not None:
                raw.masked_fill_(mask.view(-1, *(1,) * (raw.dim() - 1)), 0.0)

    def read_state(self) -> None:
        """Copy what terms use from the engine, in palm-frame float32; NaN worlds read as zeros, flagged in `nan`
        [N]."""
        wp.launch(self._read, dim=self._read_dim, inputs=self._read_args, device=self.device)
        if not self.scene.free:
            self._read_object()
        if self.servo.misread:  # what a hand's own sensors say is all that a policy will know of them
            ok = ~self.nan[:, None]
            for own, reported in ((self.q, self.servo.position()), (self.qd, self.servo.velocity())):
                own.copy_(torch.where(ok, reported, 0.0))
        if self.reality is not None:
            self.reality.read(self)

    def followers(self) -> torch.Tensor:
        """Return angles [N, S] rad of measured joints without a drive (`sensed` of hand.yaml)."""
        return torch.nan_to_num(self.engine.t.qpos[:, self._sensed_q].float())

    def _read_object(self) -> None:
        """Read pose and velocity of an object on a joint; `object_joint` [N] rad or m and `object_speed` [N]."""
        e = self.engine.t
        if self.scene.object is None:
            return
        body, (at_q, at_v) = self.objects.body, self._object_at
        turned = rotation.from_matrix(e.xmat[:, body].float())
        self.object_pose.copy_(torch.nan_to_num(torch.cat([e.xpos[:, body].float(), turned], 1)))
        self.object_joint.copy_(torch.nan_to_num(e.qpos[:, at_q].float()))
        self.object_speed.copy_(torch.nan_to_num(e.qvel[:, at_v].float()))
        self.object_velocity.zero_()
        part = 0 if isinstance(self.scene.object, Slide) else 3
        self.object_velocity[:, part : part + 3] = self.object_speed[:, None] * self.object_axis

    def _kernels(self) -> None:
        """Choose the kernels that `read_state` and `_clear_touch` launch."""
        e, state = self.engine, self.engine.wp
        self._read = state_kernels.read_kernel(e.real)
        self._read_dim = self.num_envs, self.num_actions + state_kernels.OBJECT_NUMBERS + self.fingers + 1
        object_q, object_v = self._object_at
        at = filled(
            state_kernels.Places, joint_q=self.joint_q, joint_v=self.joint_v, object_q=object_q, object_v=object_v,
            tip_body=self.tip_body, tip_offset=self.tip_offset,
        )  # fmt: skip
        names = state_kernels.Seen.vars  # type: ignore[attr-defined]  # wp.struct adds it
        seen = filled(state_kernels.Seen, **{name: getattr(self, name) for name in names})
        self._read_args = [
            state.flags, state.qpos, state.qvel, wp.from_torch(self.servo.torque), state.pair_normal, state.xpos,
            state.xmat, at, seen,
        ]  # fmt: skip
        base = self.scene.base
        self._moves: tuple[float, float | None] = (0.0, 0.0)
        self._reaches = torch.zeros(2, self.num_actions, device=self.device)
        if base is not None:
            far = [[x[0]] * 3 + [x[1]] * 3 for x in (base.scale, base.lead)]
            self._reaches[:, len(self.hand.joints) :] = torch.tensor(far)
        self._reach = filled(
            state_kernels.Reach, relative=False, scale=self._reaches[0], lead=self._reaches[1], low=self.q_low,
            high=self.q_high,
            middle=self.q_mid, half=self.q_half,
        )  # fmt: skip
        self._act_args = [wp.from_torch(x) for x in (self.q, self.action, self.last_action, self.target)]
        touch = self.touch
        self._touch_args = [
            wp.from_torch(self.pad_body.to(torch.int32)), wp.from_torch(self.pad_centre, dtype=wp.vec3),
            *map(wp.from_torch, (touch.force, touch.force_clean, touch.force_other)),
            *(wp.from_torch(x, dtype=wp.vec3) for x in (touch.centre, touch.centre_clean)),
        ]  # fmt: skip

    def kernels(self) -> list[wp.Kernel]:
        """Return kernels of a step beside its physics, one of each module at least; a task adds its own."""
        real = self.engine.real
        own = [self._read, state_kernels.act, nan_dump.keep_world]
        write = [] if self.scene.object is None else [object_kernel.write_kernel(real)]
        return [*own, *write, servos.draw_kernel(real), randomize.spread]

    def _name_kernels(self) -> None:
        """Launch each kernel once, for `dexsim.sim.warmup`, which only notes what is launched."""
        for kernel in self.kernels():
            wp.launch(kernel, dim=1)
        t, nobody = self.engine.t, torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.engine.set_state(nobody, t.qpos, t.qvel)
        self.servo.send(self.target)
        self.servo.before_each()
        self.feel()
