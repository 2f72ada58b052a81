"""`Objects.write`, one kernel, against the same in torch, term by term."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from worlds import hand_scene, random_values

N = 24
NAMES = (
    "geom_pos", "geom_quat", "geom_size", "geom_dataid", "geom_rbound", "geom_aabb", "geom_friction", "geom_solref",
    "body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_iquat", "body_invweight0",
)  # fmt: skip


def primitive_inertia(kind: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """Return the principal inertia per kg [N, 3] m^2 of box (0), sphere (1), capsule (2) with MuJoCo's sizes [N, 3]."""
    a, b, c = size.unbind(1)
    box = torch.stack([b**2 + c**2, a**2 + c**2, a**2 + b**2], 1) / 3
    sphere = (0.4 * a**2)[:, None].expand(-1, 3)
    tube, ball = 2 * torch.pi * a**2 * b, 4 / 3 * torch.pi * a**3
    volume = (tube + ball).clamp(min=1e-12)
    across = (tube * (a**2 / 4 + b**2 / 3) + ball * (0.4 * a**2 + b**2 + 0.75 * a * b)) / volume
    along = (tube * a**2 / 2 + ball * 0.4 * a**2) / volume
    capsule = torch.stack([across, across, along], 1)
    return torch.stack([box, sphere, capsule], 1).gather(1, kind.clamp(max=2)[:, None, None].expand(-1, 1, 3))[:, 0]


def expected(objects, scene, before: dict, mask, variant, scale, mass, com, friction, stiffness, damping_ratio) -> dict:
    """Return the fields, and what is remembered, after a write over `before`."""
    kinds = {"box": 0, "sphere": 1, "capsule": 2}
    kind = torch.tensor([kinds.get(v.shape.kind, 3) for v in scene.variants])[variant]
    rows = [scene.variants[int(v)] for v in variant]
    hull = kind == 3
    prim = torch.tensor(np.array([v.shape.size for v in rows]), dtype=torch.float32) * scale
    r, h = prim[:, 0], prim[:, 1]
    half = torch.stack([prim, r[:, None].expand(-1, 3), torch.stack([r, r, r + h], 1)], 1)
    half = half.gather(1, kind.clamp(max=2)[:, None, None].expand(-1, 1, 3))[:, 0]
    far = torch.tensor(
        [max(float((p**2).sum(1).max()) for p in v.shape.hulls) ** 0.5 * v.scale if v.shape.hulls else 0 for v in rows]
    )
    bound = torch.stack([prim.norm(dim=1), r, r + h, far], 1).gather(1, kind[:, None])[:, 0]
    largest = torch.tensor([max(v.shape.extents) * v.scale for v in rows], dtype=torch.float32)
    extent = torch.where(hull, largest, 2 * half.amax(1))
    unit = torch.tensor(np.array([np.diag(v.shape.inertia_unit) * v.scale**2 for v in rows]), dtype=torch.float32)
    inertia = torch.where(hull[:, None], unit, primitive_inertia(kind, prim)) * mass[:, None]
    com = com * extent[:, None]
    grown = torch.tensor([v.scale for v in rows], dtype=torch.float32)
    size = torch.where(hull[:, None], torch.stack([grown, 0 * mass, 0 * mass], 1), prim)

    out = {name: value.clone() for name, value in before.items()}
    for w in torch.arange(N)[mask].tolist():
        v = int(variant[w])
        for name, value in (
            ("variant", variant), ("mass", mass), ("friction", friction), ("stiffness", stiffness), ("size", size),
            ("com", com), ("damping_ratio", damping_ratio), ("radius", bound),
        ):  # fmt: skip
            out[name][w] = value[w]
        for s, g in enumerate(objects.slots.tolist()):
            for name in ("pos", "quat", "size", "dataid", "rbound", "aabb"):
                value = torch.as_tensor(getattr(scene, name)[v, s])
                out[f"geom_{name}"][w, g] = value.reshape(out[f"geom_{name}"][w, g].shape)
            if s == kind[w] and not hull[w]:
                out["geom_size"][w, g], out["geom_rbound"][w, g] = prim[w], bound[w]
                box = torch.cat([torch.zeros(3), half[w]])
                out["geom_aabb"][w, g] = box.reshape(out["geom_aabb"][w, g].shape)
        b = objects.body
        out["body_mass"][w, b] = out["body_subtreemass"][w, b] = mass[w]
        out["body_subtreemass"][w, 0] = out["body_subtreemass"][w, 1] + mass[w]
        out["body_inertia"][w, b], out["body_ipos"][w, b] = inertia[w], com[w]
        out["body_iquat"][w, b] = torch.tensor([1.0, 0, 0, 0])
        out["body_invweight0"][w, b] = torch.stack([1 / mass[w], (1 / inertia[w]).mean()])
        a = out["body_invweight0"][w, objects.tip_bodies, 0].float() + 1 / mass[w]
        k = stiffness[w] * (1 - objects.impedance) * a
        damping = 2 * damping_ratio[w] * k.sqrt()
        out["geom_solref"][w, objects.tips] = torch.stack([-k, -damping], 1).to(out["geom_solref"].dtype)
        slide = friction[w] * objects.friction_factor
        out["geom_friction"][w, objects.hand_geoms, 0] = slide.to(out["geom_friction"].dtype)
    return out


def now(engine, objects) -> dict:
    fields = {name: engine.field(name).clone() for name in NAMES}
    return fields | {k: (v[0] if isinstance(v, tuple) else v).clone() for k, v in objects.memory().items()}


@pytest.mark.parametrize("kind", ["mujoco", "warp"])
def test_a_write_is_what_it_is_in_torch(kind):
    engine, scene, objects = hand_scene(N, kind=kind)
    factor = torch.linspace(0.8, 1.2, len(objects.hand_geoms))
    objects.friction_factor = factor
    everyone, some = torch.ones(N, dtype=torch.bool), torch.arange(N) % 3 == 0
    for seed, mask in ((0, everyone), (1, some), (2, ~some)):
        before = now(engine, objects)
        values = random_values(N, len(scene.variants), seed)
        objects.write(mask, **values)
        want, got = expected(objects, scene, before, mask, **values), now(engine, objects)
        for name, value in want.items():
            torch.testing.assert_close(got[name], value, rtol=2e-6, atol=1e-9, msg=lambda m, n=name: f"{n}: {m}")
            assert torch.equal(got[name][~mask], before[name][~mask]), name
    assert not torch.equal(got["geom_friction"], before["geom_friction"]), "friction came through"
    assert set(objects.kind[objects.variant].tolist()) == {0, 1, 2, 3}, "every kind was written"
