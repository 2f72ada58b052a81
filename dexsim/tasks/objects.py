"""The object of each world: shape, size, mass, centre of mass, friction and the rubber it is touched with.

Everything is written from the nominal table of `sim.scene.Scene`, never from the values of the last episode, so that
randomization cannot compound; and what MuJoCo derives from a free body's mass and inertia is written with them.
"""

from __future__ import annotations

import numpy as np
import torch

from dexsim.sim import Engine
from dexsim.sim.scene import OBJECT, Scene


class Objects:
    """Writes the object fields of the worlds that a mask selects.

    Attributes (torch, by world): variant [N] int64 row of the scene's table; size [N, 3] as touch wants it
    (MuJoCo sizes of a primitive, or (scale, 0, 0)); mass [N] kg; com [N, 3] m, of the body frame; friction [N];
    stiffness [N] N/m and damping_ratio [N] of fingertip contacts; radius [N] m, of a sphere about the body frame
    that holds the object.
    """

    def __init__(self, engine: Engine, scene: Scene, tip_geoms: list[str], impedance: float):
        self.engine, self.scene, self.impedance = engine, scene, impedance
        dev, n = engine.device, engine.n
        self.body = engine.body(OBJECT)
        self.slots = torch.tensor([engine.geom(s) for s in scene.slots], device=dev)
        self.tips = torch.tensor([engine.geom(g) for g in tip_geoms], device=dev)
        self.tip_bodies = torch.as_tensor(engine.mjm.geom_bodyid[self.tips.cpu().numpy()], device=dev).long()
        hand = [
            g for g in range(engine.mjm.ngeom) if engine.mjm.geom_bodyid[g] != self.body and engine.mjm.geom_contype[g]
        ]
        self.hand_geoms = torch.tensor(hand, device=dev)

        def table(x, dtype=torch.float32):
            return torch.as_tensor(np.asarray(x), dtype=dtype, device=dev)

        self._dataid = table(scene.dataid, torch.int32)
        self._pos, self._quat, self._size = table(scene.pos), table(scene.quat), table(scene.size)
        self._rbound, self._aabb = table(scene.rbound), table(scene.aabb)
        kinds = [v.shape.kind for v in scene.variants]
        self.kind = torch.tensor([{"box": 0, "sphere": 1, "capsule": 2}.get(k, 3) for k in kinds], device=dev)
        self._scale = table([v.scale for v in scene.variants])
        self._unit_inertia = table(
            [[v.shape.inertia_unit[i, i] * v.scale**2 for i in range(3)] for v in scene.variants]
        )
        self._base_size = table([v.shape.size for v in scene.variants])
        self._extent = table([max(v.shape.extents) * v.scale for v in scene.variants])
        self._bound = table(
            [
                0.0
                if v.shape.kind != "grid"
                else max(float((h**2).sum(1).max()) for h in v.shape.hulls) ** 0.5 * v.scale
                for v in scene.variants
            ]
        )
        self._identity = torch.tensor([1.0, 0, 0, 0], device=dev)
        self.variant = torch.zeros(n, dtype=torch.int64, device=dev)
        self.size = torch.zeros(n, 3, device=dev)
        self.mass, self.friction = torch.full((n,), 0.1, device=dev), torch.ones(n, device=dev)
        self.com = torch.zeros(n, 3, device=dev)
        self.stiffness, self.damping_ratio = torch.full((n,), 7000.0, device=dev), torch.ones(n, device=dev)
        self.radius = torch.zeros(n, device=dev)
        self.friction_factor: torch.Tensor | None = None  # [G] of each hand geom over the world's friction

    def memory(self) -> dict[str, torch.Tensor | tuple[torch.Tensor, int, int]]:
        """Each world's object, live; the row of the table with its lowest and highest."""
        names = ("size", "mass", "com", "friction", "stiffness", "damping_ratio", "radius")
        return {"variant": (self.variant, 0, len(self.kind) - 1)} | {name: getattr(self, name) for name in names}

    def primitive_size(self, variant: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        """MuJoCo sizes [N, 3] m of each world's primitive: its base size times scale [N, 3] (component by
        component)."""
        return self._base_size[variant] * scale

    def write(
        self,
        mask: torch.Tensor,
        variant: torch.Tensor,
        scale: torch.Tensor,
        mass: torch.Tensor,
        com: torch.Tensor,
        friction: torch.Tensor,
        stiffness: torch.Tensor,
        damping_ratio: torch.Tensor,
    ) -> None:
        """Where mask [N] holds, give the world this object.

        variant [N] row of the scene's table; scale [N, 3] of a primitive's sizes (hulls keep their baked scale);
        mass [N] kg; com [N, 3]: offset of the centre of mass as a fraction of the largest extent; friction [N]
        (sliding); stiffness [N] N/m, damping_ratio [N] of tip contacts.
        """
        kind = self.kind[variant]
        hull = kind == 3
        prim = self.primitive_size(variant, scale)
        size = torch.where(hull[:, None], torch.stack([self._scale[variant], 0 * mass, 0 * mass], 1), prim)
        r, h = prim[:, 0], prim[:, 1]
        half = torch.stack(  # half extents of each primitive kind (box, sphere, capsule)
            [prim, r[:, None].expand(-1, 3), torch.stack([r, r, r + h], 1)], 1
        )
        half = half.gather(1, kind.clamp(max=2)[:, None, None].expand(-1, 1, 3))[:, 0]
        bound = torch.stack([prim.norm(dim=1), r, r + h, self._bound[variant]], 1).gather(1, kind[:, None])[:, 0]
        extent = torch.where(hull, self._extent[variant], 2 * half.amax(1))
        inertia = (
            torch.where(hull[:, None], self._unit_inertia[variant], _primitive_inertia(kind, prim)) * mass[:, None]
        )
        com = com * extent[:, None]
        m1 = mask[:, None]
        for own, new in (
            (self.variant, variant),
            (self.mass, mass),
            (self.friction, friction),
            (self.stiffness, stiffness),
            (self.damping_ratio, damping_ratio),
            (self.radius, bound),
        ):
            own.copy_(torch.where(mask, new, own))
        self.size.copy_(torch.where(m1, size, self.size))
        self.com.copy_(torch.where(m1, com, self.com))
        self._write_geoms(mask, variant, kind, prim, half, bound)
        self._write_inertia(mask, mass, inertia, com)
        self._write_contact()

    def _write_geoms(self, mask, variant, kind, prim, half, bound) -> None:
        S = len(self.scene.slots)
        size, rbound, aabb = self._size[variant].clone(), self._rbound[variant].clone(), self._aabb[variant].clone()
        # the primitive slot in use
        own = (torch.arange(S, device=kind.device)[None] == kind[:, None]) & (kind < 3)[:, None]
        size = torch.where(own[..., None], prim[:, None], size)
        rbound = torch.where(own, bound[:, None], rbound)
        aabb = torch.where(own[..., None], torch.cat([torch.zeros_like(half), half], 1)[:, None], aabb)
        rows = (
            ("geom_pos", self._pos[variant]),
            ("geom_quat", self._quat[variant]),
            ("geom_size", size),
            ("geom_dataid", self._dataid[variant]),
            ("geom_rbound", rbound),
            ("geom_aabb", aabb),
        )
        for name, value in rows:
            f = self.engine.field(name)
            f = f.view(f.shape[0], f.shape[1], -1) if f.dim() > 2 else f[..., None]
            value = value.reshape(value.shape[0], S, -1).to(f.dtype)
            f[:, self.slots] = torch.where(mask[:, None, None], value, f[:, self.slots])

    def _write_inertia(self, mask, mass, inertia, com) -> None:
        e, b, m1 = self.engine, self.body, mask[:, None]
        # A free body's derived constants in closed form (mj_setConst gives the same; tested): translational inverse
        # weight 1/m, rotational the mean inverse inertia.
        inverse = (1 / inertia).mean(1)
        weight = torch.stack([1 / mass, inverse], 1)
        for name, value in (("body_mass", mass), ("body_subtreemass", mass)):
            f = e.field(name)
            f[:, b] = torch.where(mask, value.to(f.dtype), f[:, b])
        world = e.field("body_subtreemass")
        world[:, 0] = world[:, 1:2].sum(1) + world[:, b]  # the world's trees: the hand (body 1) and the object
        for name, value in (
            ("body_inertia", inertia),
            ("body_ipos", com),
            ("body_iquat", self._identity.expand(len(mass), 4)),
            ("body_invweight0", weight),
        ):
            f = e.field(name)
            f[:, b] = torch.where(m1, value.to(f.dtype), f[:, b])

    def _write_contact(self) -> None:
        """Friction on every hand geom, stiffness on the tips.

        MuJoCo's contact reference acts on acceleration. With constant impedance d a contact at rest at depth r carries
        f = -solref[0] r / ((1 - d) A), A = body_invweight0 of the two bodies, so solref = (-K (1 - d) A, -b) makes it
        K r, whatever the mass; b = 2 zeta sqrt(K (1 - d) A) damps the contact at the ratio zeta (semi-implicitly, at
        the effective mass that A describes). Restitution has no coefficient in MuJoCo: this damping stands for it.
        """
        e = self.engine
        weight = e.field("body_invweight0")[..., 0].float()
        a = weight[:, self.tip_bodies] + weight[:, self.body][:, None]
        k = self.stiffness[:, None] * (1 - self.impedance) * a
        b = 2 * self.damping_ratio[:, None] * k.sqrt()
        solref = e.field("geom_solref")
        solref[:, self.tips] = torch.stack([-k, -b], -1).to(solref.dtype)
        friction = e.field("geom_friction")
        value = (
            self.friction[:, None] if self.friction_factor is None else self.friction[:, None] * self.friction_factor
        )
        friction[:, self.hand_geoms, 0] = value.to(friction.dtype)


def _primitive_inertia(kind: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """Principal inertia per kg [N, 3] m^2 of box (0), sphere (1), capsule (2) with MuJoCo sizes [N, 3]; see
    `assets.objects.shape.primitive_mass_properties` for the formulas."""
    a, b, c = size.unbind(1)
    box = torch.stack([b**2 + c**2, a**2 + c**2, a**2 + b**2], 1) / 3
    sphere = (0.4 * a**2)[:, None].expand(-1, 3)
    tube, ball = 2 * torch.pi * a**2 * b, 4 / 3 * torch.pi * a**3
    volume = (tube + ball).clamp(min=1e-12)
    across = (tube * (a**2 / 4 + b**2 / 3) + ball * (0.4 * a**2 + b**2 + 0.75 * a * b)) / volume
    along = (tube * a**2 / 2 + ball * 0.4 * a**2) / volume
    capsule = torch.stack([across, across, along], 1)
    return torch.stack([box, sphere, capsule], 1).gather(1, kind.clamp(max=2)[:, None, None].expand(-1, 1, 3))[:, 0]
