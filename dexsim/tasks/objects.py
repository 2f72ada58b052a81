"""The object of each world: shape, size, mass, centre of mass, friction and the rubber it is touched with.

Everything is written from the nominal table of `sim.scene.Scene`, never from the values of the last episode, so that
randomization cannot compound; and what MuJoCo derives from a free body's mass and inertia is written with them
(`object_kernel.py`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from dexsim.sim import Engine
from dexsim.sim.scene import OBJECT, Scene
from dexsim.tasks import object_kernel as kernel


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

        def table(x: Any, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.as_tensor(np.asarray(x), dtype=dtype, device=dev)

        kinds, scales = [v.shape.kind for v in scene.variants], [v.scale for v in scene.variants]
        named = {"box": kernel.BOX, "sphere": kernel.SPHERE, "capsule": kernel.CAPSULE}
        self.kind = torch.tensor([named.get(k, kernel.HULL) for k in kinds], device=dev)
        self._base_size = table([v.shape.size for v in scene.variants])
        self._extent = table([max(v.shape.extents) * v.scale for v in scene.variants])
        inertia = [[v.shape.inertia_unit[i, i] * v.scale**2 for i in range(3)] for v in scene.variants]
        bound = [
            0.0 if v.shape.kind != "grid" else max(float((h**2).sum(1).max()) for h in v.shape.hulls) ** 0.5 * v.scale
            for v in scene.variants
        ]
        self._table = t = kernel.Table()
        for name in ("pos", "quat", "size", "aabb"):
            setattr(t, name, wp.from_torch(table(getattr(scene, name)).flatten(2)))
        t.rbound = wp.from_torch(table(scene.rbound)[..., None])
        t.dataid = wp.from_torch(table(scene.dataid, torch.int32))
        t.base_size, t.unit_inertia = (wp.from_torch(x, dtype=wp.vec3) for x in (self._base_size, table(inertia)))
        for name, values in (("scale", table(scales)), ("extent", self._extent), ("bound", table(bound))):
            setattr(t, name, wp.from_torch(values))
        for name in ("kind", "slots", "tips", "tip_bodies", "hand_geoms"):
            setattr(t, name, wp.from_torch(getattr(self, name).to(torch.int32)))
        self.friction_factor = torch.ones(len(hand), device=dev)

        self.variant = torch.zeros(n, dtype=torch.int64, device=dev)
        self.size = torch.zeros(n, 3, device=dev)
        self.mass, self.friction = torch.full((n,), 0.1, device=dev), torch.ones(n, device=dev)
        self.com = torch.zeros(n, 3, device=dev)
        self.stiffness, self.damping_ratio = torch.full((n,), 7000.0, device=dev), torch.ones(n, device=dev)
        self.radius = torch.zeros(n, device=dev)
        self._known, self._fields = kernel.Known(), kernel.fields(engine.real)()
        for name in self.memory():
            setattr(self._known, name, wp.from_torch(getattr(self, name)))
        for name in kernel.fields(engine.real).vars:
            field = engine.field(name)
            field = field if name == "geom_dataid" else field.view(*field.shape[:2], -1)
            setattr(self._fields, name, wp.from_torch(field))
        self._drawn = kernel.Drawn()
        self._dim = n, max(len(hand), len(scene.slots), len(tip_geoms))

    @property
    def friction_factor(self) -> torch.Tensor:
        """Of each hand geom over the world's friction [G]; `hand_geoms` names them."""
        return self._friction_factor

    @friction_factor.setter
    def friction_factor(self, factor: torch.Tensor) -> None:
        self._friction_factor = factor.to(self.engine.device, torch.float32).contiguous()
        self._table.friction_factor = wp.from_torch(self._friction_factor)

    def memory(self) -> dict[str, torch.Tensor | tuple[torch.Tensor, int, int]]:
        """Return each world's object, live; the row of the table with its lowest and highest."""
        names = ("size", "mass", "com", "friction", "stiffness", "damping_ratio", "radius")
        return {"variant": (self.variant, 0, len(self.kind) - 1)} | {name: getattr(self, name) for name in names}

    def primitive_size(self, variant: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        """Return MuJoCo sizes [N, 3] m of each world's primitive: its base size times scale [N, 3] (component by
        component)."""
        return self._base_size[variant] * scale

    def write(
        self, mask: torch.Tensor, variant: torch.Tensor, scale: torch.Tensor, mass: torch.Tensor, com: torch.Tensor,
        friction: torch.Tensor, stiffness: torch.Tensor, damping_ratio: torch.Tensor,
    ) -> None:  # fmt: skip
        """Give the worlds where mask [N] holds this object.

        variant [N] row of the scene's table; scale [N, 3] of a primitive's sizes (hulls keep their baked scale);
        mass [N] kg; com [N, 3]: offset of the centre of mass as a fraction of the largest extent; friction [N]
        (sliding); stiffness [N] N/m, damping_ratio [N] of tip contacts.
        """
        given = {"mask": mask, "variant": variant, "scale": scale, "mass": mass, "com": com, "friction": friction}
        for name, value in (given | {"stiffness": stiffness, "damping_ratio": damping_ratio}).items():
            setattr(self._drawn, name, wp.from_torch(value))
        wp.launch(
            kernel.write_kernel(self.engine.real),
            dim=self._dim,
            inputs=[self.body, self.impedance, self._drawn, self._table, self._known, self._fields],
            device=self.engine.device,
        )
