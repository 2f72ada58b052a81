"""The hand model against the measured figures (typed in here), its lattice, its hulls and its collision filter."""

from __future__ import annotations

import csv
import shutil

import mujoco
import numpy as np
import pytest
import trimesh

from dexsim.assets import xhand
from dexsim.assets.xhand import build
from dexsim.assets.xhand.surface import PADS, Lattice, to_link, to_sensor

# Measured: mass (kg), com (m), ixx iyy izz ixy ixz iyz (kg m^2) of the moving links alone, link frame.
LINKS = {
    "right_hand_link": (0.53851506, (0.0100351, -0.0036684, 0.0582695),
                        (6.4186e-4, 4.6434e-4, 2.7538e-4, 2e-8, -2.17e-6, 5.134e-5)),
    "right_hand_thumb_bend_link": (0.01151453, (-0.0011653, 0.0144359, 0.0000541),
                                   (1.55e-6, 6.2e-7, 1.57e-6, -3e-8, 1e-11, 7e-8)),
    "right_hand_thumb_rota_link1": (0.1322853, (-0.0003618, 0.0287681, 0.0013393),
                                    (3.665e-5, 1.694e-5, 4.358e-5, -7.88e-6, 1.98e-6, 1.85e-6)),
    "right_hand_thumb_rota_link2": (0.03516871, (-0.0008816, 0.022534, 0.0006146),
                                    (7.79e-6, 3.5e-6, 8.96e-6, -2e-8, 3.4e-7, -1.8e-7)),
    "right_hand_index_bend_link": (0.068721, (-0.0007159, 0.000119, 0.0111903),
                                   (1.643e-5, 1.707e-5, 3.43e-6, 1e-11, 1.3e-7, -1.1e-7)),
    "right_hand_index_rota_link1": (0.06298297, (0.0006329, 0.000133, 0.0355869),
                                    (1.686e-5, 1.738e-5, 3.2e-6, 1e-11, -1.9e-7, -2.8e-7)),
    "right_hand_index_rota_link2": (0.01582395, (0.0011991, -0.0002484, 0.021379),
                                    (2.83e-6, 2.77e-6, 8.5e-7, 1e-11, -7e-8, -1.2e-7)),
}  # fmt: skip
for _finger in ("mid", "ring", "pinky"):
    LINKS[f"right_hand_{_finger}_link1"] = (0.06298297, (0.0005304, 0.0000358, 0.0332785),
                                            (1.681e-5, 1.738e-5, 3.25e-6, 1e-11, -8.7e-7, -2.8e-7))  # fmt: skip
    LINKS[f"right_hand_{_finger}_link2"] = (0.01582395, (0.0011991, -0.0002484, 0.021379),
                                            (2.87e-6, 2.83e-6, 8.7e-7, -1e-8, -1.9e-7, -1.2e-7))  # fmt: skip
CLUSTER_MASS = {
    "right_hand_link": 0.53852073, "right_hand_thumb_bend_link": 0.01151453, "right_hand_thumb_rota_link1": 0.13228536,
    "right_hand_thumb_rota_link2": 0.0351744, "right_hand_index_bend_link": 0.068721,
    "right_hand_index_rota_link1": 0.06298299, "right_hand_index_rota_link2": 0.01582961,
}  # fmt: skip
# Measured tip positions at zero in the root link's frame (x out of the palm, y to the thumb, z along the fingers), m.
TIPS = {
    "palm": (0, 0, 0.065),
    "tip_thumb": (0.022111, 0.156839, 0.02872),
    "tip_index": (0.0065, 0.0265, 0.205748),
    "tip_mid": (0.0065, 0.004, 0.206248),
    "tip_ring": (0.0065, -0.016, 0.203248),
    "tip_pinky": (0.0065, -0.036, 0.200248),
}
STRONG, WEAK = (1.1, 8.63), (0.4, 14.38)
JOINTS = [
    ("thumb_bend_joint", 0.0, 1.832, STRONG), ("thumb_rota_joint1", -0.698, 1.57, STRONG),
    ("thumb_rota_joint2", 0.0, 1.57, WEAK), ("index_bend_joint", -0.174, 0.174, WEAK),
    ("index_joint1", 0.0, 1.919, STRONG), ("index_joint2", 0.0, 1.919, WEAK),
    ("mid_joint1", 0.0, 1.919, STRONG), ("mid_joint2", 0.0, 1.919, WEAK),
    ("ring_joint1", 0.0, 1.919, STRONG), ("ring_joint2", 0.0, 1.919, WEAK),
    ("pinky_joint1", 0.0, 1.919, STRONG), ("pinky_joint2", 0.0, 1.919, WEAK),
]  # fmt: skip
AREA = {"thumb": 1243.8e-6, "finger": 719.18e-6}
MIRROR = {"thumb": 0, "finger": 1}  # link axis that changes sign
FINGER_OF = {"thumb": "thumb", "finger": "index"}


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_path(str(xhand.xml_path()))


@pytest.fixture()
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def lattice(pad: str) -> np.ndarray:
    return xhand.taxel_table(FINGER_OF[pad])["position"].reshape(xhand.COLUMNS, xhand.ROWS, 3)


def surface(pad: str) -> Lattice:
    return Lattice(to_sensor(lattice(pad), PADS[pad]))


def geom_mesh(model, name: str) -> trimesh.Trimesh:
    """Convex hull of a mesh geom in its body's frame, as the physics sees it."""
    geom = model.geom(name).id
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    vertices = model.mesh_vert[first : first + count] @ rotation.reshape(3, 3).T + model.geom_pos[geom]
    return trimesh.convex.convex_hull(vertices)


def distance(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Unsigned distance of points to a small mesh by brute force."""
    triangles = mesh.triangles
    closest = trimesh.triangles.closest_point(
        np.tile(triangles, (len(points), 1, 1)), np.repeat(points, len(triangles), axis=0)
    )
    gap = np.linalg.norm(closest - np.repeat(points, len(triangles), axis=0), axis=1)
    return gap.reshape(len(points), -1).min(axis=1)


def inertia_in_link_axes(model, body: int) -> np.ndarray:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    rotation = rotation.reshape(3, 3)
    return rotation @ np.diag(model.body_inertia[body]) @ rotation.T


def test_total_mass_and_body_count(model):
    assert model.body_mass.sum() == pytest.approx(1.1014664, abs=1e-6)
    assert model.nbody - 1 == 13 == len(LINKS)
    for name, mass in CLUSTER_MASS.items():
        assert model.body(name).mass[0] == pytest.approx(mass, abs=2e-8)


@pytest.mark.parametrize("name", LINKS)
def test_body_inertials(model, name):
    mass, com, (ixx, iyy, izz, ixy, ixz, iyz) = LINKS[name]
    body = model.body(name).id
    # Folding the tip marker in (6 mg, up to 28 mm off) moves the centre by < 10 um, the inertia by < 5e-9.
    assert model.body_mass[body] == pytest.approx(mass, abs=6e-6)
    np.testing.assert_allclose(model.body_ipos[body], com, atol=1e-5)
    expected = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    np.testing.assert_allclose(inertia_in_link_axes(model, body), expected, atol=5e-9)


@pytest.mark.parametrize("site", TIPS)
def test_tip_positions_at_zero(data, site):
    x, y, z = TIPS[site]
    np.testing.assert_allclose(data.site(site).xpos, (z - 0.065, -y, x), atol=1e-4)


def test_world_frame_is_the_palm_frame(data):
    np.testing.assert_allclose(data.site("palm").xmat.reshape(3, 3), np.eye(3), atol=1e-9)


def test_joints_limits_efforts_speeds_in_sdk_order(model):
    names = [name for name, *_ in JOINTS]
    assert [model.joint(i).name for i in range(model.njnt)] == names == list(xhand.JOINTS)
    limits = np.array([(low, high) for _, low, high, _ in JOINTS])
    np.testing.assert_allclose(model.jnt_range, limits)
    np.testing.assert_allclose(xhand.joint_limits(), limits)
    assert model.jnt_limited.all()
    np.testing.assert_allclose(xhand.efforts(), [kind[0] for *_, kind in JOINTS])
    np.testing.assert_allclose(xhand.speeds(), [kind[1] for *_, kind in JOINTS])
    np.testing.assert_allclose(model.dof_armature, [{1.1: 5e-4, 0.4: 2e-4}[kind[0]] for *_, kind in JOINTS])
    assert model.nu == 0


def test_joint_axes_move_the_tips_the_measured_way(model, data):
    """Flexion lifts the tip out of the palm; the index swings to the thumb; the thumb bends up out
    of the palm and its two other joints close it in the direction of the fingers (its pad faces them at zero)."""
    start = {site: data.site(site).xpos.copy() for site in TIPS}
    moves = [(4, "tip_index", 2, 1), (5, "tip_index", 2, 1), (6, "tip_mid", 2, 1), (7, "tip_mid", 2, 1),
             (8, "tip_ring", 2, 1), (9, "tip_ring", 2, 1), (10, "tip_pinky", 2, 1), (11, "tip_pinky", 2, 1),
             (1, "tip_thumb", 0, 1), (2, "tip_thumb", 0, 1),
             (3, "tip_index", 1, -1), (0, "tip_thumb", 2, 1)]  # fmt: skip
    for joint, site, axis, sign in moves:
        data.qpos[:] = 0
        data.qpos[joint] = 0.15
        mujoco.mj_forward(model, data)
        moved = (data.site(site).xpos - start[site])[axis] * sign
        assert moved > 0.003, (xhand.JOINTS[joint], moved)


def test_no_self_contact_at_rest(model, data):
    assert data.ncon == 0


def test_unrelated_collision_geoms_do_not_overlap_at_rest(model, data):
    """Whatever the filter says: geoms of bodies that are neither equal nor neighbours keep clear of each other."""
    geoms = [g for g in range(model.ngeom) if model.geom_contype[g]]
    chain = lambda b: {b, model.body_parentid[b]}  # noqa: E731
    checked = 0
    for i, a in enumerate(geoms):
        for b in geoms[:i]:
            bodies = model.geom_bodyid[a], model.geom_bodyid[b]
            if bodies[0] in chain(bodies[1]) or bodies[1] in chain(bodies[0]):
                continue
            if 1 in bodies:  # the palm holds the roots of the index and the thumb
                other = max(bodies)
                if model.body(other).name in ("right_hand_index_rota_link1", "right_hand_thumb_rota_link1"):
                    continue
            gap = mujoco.mj_geomDistance(model, data, a, b, 0.1, None)
            assert gap > 0, (model.geom(a).name, model.geom(b).name, gap)
            checked += 1
    assert checked > 150


def test_only_capsules_and_one_small_hull_per_tip_collide(model):
    colliding = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    tips = [g for g in colliding if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH]
    assert sorted(model.geom(g).name for g in tips) == sorted(xhand.TIP_GEOMS)
    for g in colliding:
        if g in tips:
            assert model.mesh_vertnum[model.geom_dataid[g]] <= 64
            assert model.geom_priority[g] == 1 and model.geom_condim[g] == 4
        else:
            assert model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE
            assert model.geom(g).name.startswith(("col_", "self_"))
        proxy = model.geom(g).name.startswith("self_")  # meets the hand, not the object
        assert bool(model.geom_contype[g] & xhand.HAND_BIT) != proxy
        assert bool(model.geom_conaffinity[g] & xhand.OBJECT_BIT) != proxy
    bodies = [model.body(model.geom_bodyid[model.geom(name).id]).name for name in xhand.TIP_GEOMS]
    assert bodies == list(xhand.TIP_BODIES)


def test_self_collision_pairs_are_the_meant_ones(model):
    """42 pairs: finger tips 6, thumb tip (2 proxies) on finger tips 8, on finger links 8 and palm 8, thumb links on
    tips 12."""
    colliding = [g for g in range(model.ngeom) if model.geom_contype[g]]
    count = 0
    for i, a in enumerate(colliding):
        for b in colliding[:i]:
            x, y = model.geom_bodyid[a], model.geom_bodyid[b]
            if x == y or model.body_parentid[x] == y or model.body_parentid[y] == x:
                continue
            if model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]:
                count += 1
                names = {model.geom(a).name, model.geom(b).name}
                assert any(name.startswith("self_") for name in names), names
    assert count == 42


def test_collision_filter_lets_an_object_touch_every_hand_geom(model):
    spec = xhand.hand_spec()
    body = spec.worldbody.add_body(name="ball", pos=[0.0762, -0.0265, 0.0365])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], contype=xhand.OBJECT_BIT,
                  conaffinity=xhand.HAND_BIT)  # fmt: skip
    with_ball = spec.compile()
    data = mujoco.MjData(with_ball)
    targets = [
        g
        for g in range(with_ball.ngeom)
        if with_ball.geom_contype[g] & xhand.HAND_BIT and with_ball.geom_bodyid[g] < 14
    ]
    for g in targets:
        data.qpos[:] = 0
        mujoco.mj_forward(with_ball, data)
        data.qpos[12:15] = data.geom_xpos[g]
        data.qpos[15] = 1
        mujoco.mj_forward(with_ball, data)
        touched = {with_ball.geom(c).name for pair in data.contact.geom for c in pair}
        assert with_ball.geom(g).name in touched


def test_capsules_stay_within_the_measured_bounds(model):
    """Every capsule lies inside its link's bounds to 1 mm (they are fitted to them)."""
    with open(xhand.FOLDER / "bodies.csv", encoding="ascii") as f:
        bounds = {row["body"]: row for row in csv.DictReader(f)}
    for g in range(model.ngeom):
        if not model.geom(g).name.startswith("col_"):
            continue
        row = bounds[model.body(model.geom_bodyid[g]).name]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        half = rotation.reshape(3, 3)[:, 2] * model.geom_size[g, 1]
        reach = np.abs(half) + model.geom_size[g, 0]
        low = [float(row[f"min_{c}"]) for c in "xyz"]
        high = [float(row[f"max_{c}"]) for c in "xyz"]
        assert (model.geom_pos[g] - reach > np.array(low) - 0.001).all(), model.geom(g).name
        assert (model.geom_pos[g] + reach < np.array(high) + 0.001).all(), model.geom(g).name


@pytest.mark.parametrize("pad", PADS)
def test_lattice_is_mirror_symmetric(pad):
    finger = FINGER_OF[pad]
    flip = np.ones(3)
    flip[MIRROR[pad]] = -1
    table = xhand.taxel_table(finger)
    shape = (xhand.COLUMNS, xhand.ROWS, 3)
    np.testing.assert_allclose(table["position"].reshape(shape)[::-1] * flip, lattice(pad), atol=1e-9)
    np.testing.assert_allclose(table["normal"].reshape(shape)[::-1] * flip, table["normal"].reshape(shape), atol=2e-6)
    np.testing.assert_allclose(table["tangent"].reshape(shape)[::-1] * -flip, table["tangent"].reshape(shape),
                               atol=2e-6)  # fmt: skip
    np.testing.assert_allclose(table["area"].reshape(10, 12)[::-1], table["area"].reshape(10, 12), rtol=1e-5)


def test_measured_taxel_points():
    """A few points of the measured lists, so that the order k = column * 12 + row is fixed (m, link frame)."""
    thumb, finger = xhand.taxel_table("thumb")["position"], xhand.taxel_table("ring")["position"]
    assert thumb.shape == finger.shape == (120, 3)
    np.testing.assert_allclose(thumb[0], (-0.01488, 0.01984, -0.00134), atol=1e-9)
    np.testing.assert_allclose(thumb[4 * 12 + 11], (-0.00086, 0.05087, -0.00271), atol=1e-9)
    np.testing.assert_allclose(finger[2 * 12 + 5], (0.00744, -0.00677, 0.0304), atol=1e-9)
    np.testing.assert_allclose(finger[9 * 12], (0.0004, 0.00832, 0.01809), atol=1e-9)


@pytest.mark.parametrize("pad", PADS)
def test_areas_sum_to_the_lattice_area(pad):
    area = xhand.taxel_table(FINGER_OF[pad])["area"]
    assert area.min() > 0
    assert area.sum() == pytest.approx(AREA[pad], rel=0.01)


@pytest.mark.parametrize("pad", PADS)
def test_normals_are_unit_outward_and_smooth(pad):
    table = xhand.taxel_table(FINGER_OF[pad])
    normal, tangent, points = table["normal"], table["tangent"], table["position"]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1, atol=2e-6)
    np.testing.assert_allclose((normal * tangent).sum(axis=1), 0, atol=3e-6)
    # Outward: every taxel's tangent plane has all other taxels on its inner side (the pad is convex) to 0.5 mm.
    side = ((points[None] - points[:, None]) * normal[:, None]).sum(axis=-1)
    assert side.max() < 5e-4
    grid = normal.reshape(xhand.COLUMNS, xhand.ROWS, 3)
    turn = np.degrees(np.arccos(np.clip((grid[:, 1:] * grid[:, :-1]).sum(-1), -1, 1)))
    assert turn.max() < 35


def test_taxel_axes_on_the_flat_of_the_pad():
    """Mid-pad the taxel frame is the sensor's: thumb (x, y, z) = link (x, y, z), finger = link (y, z, x)."""
    for finger, x_axis, z_axis in (("thumb", (1, 0, 0), (0, 0, 1)), ("mid", (0, 1, 0), (1, 0, 0))):
        table = xhand.taxel_table(finger)
        k = 4 * 12 + 1
        assert table["tangent"][k] @ x_axis > 0.99
        assert table["normal"][k] @ z_axis > 0.98


@pytest.mark.parametrize("pad", PADS)
def test_collision_hull_follows_the_skin(model, pad):
    hull = geom_mesh(model, f"tip_{FINGER_OF[pad]}")
    skin = surface(pad)
    u, v = skin.grid(41, 49)
    fine = to_link(skin.position(u, v).reshape(-1, 3), PADS[pad])
    # the mesh is the tip shrunk by the geom's margin: the contact surface lies that far outside it
    margin = model.geom_margin[model.geom(f"tip_{FINGER_OF[pad]}").id]
    assert margin == pytest.approx(0.0015)
    assert np.abs(distance(hull, lattice(pad).reshape(-1, 3)) - margin).max() <= 3e-4
    assert np.abs(distance(hull, fine) - margin).max() <= 3e-4
    assert hull.is_watertight and 2e-6 < hull.volume < 3e-5  # it closes the back


@pytest.mark.parametrize("finger", xhand.FINGERS)
def test_skin_mesh_is_closed_and_passes_through_the_taxels(finger):
    vertices, faces = xhand.tip_skin_mesh(finger)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.is_convex and mesh.volume > 4e-6
    offset = (mesh.face_normals * mesh.triangles[:, 0]).sum(axis=1)
    plane = xhand.taxel_table(finger)["position"] @ mesh.face_normals.T - offset
    assert abs(plane.max(axis=1)).max() < 1e-4  # signed distance to a convex solid


def test_tables_agree_with_the_generator(tmp_path, monkeypatch):
    """The committed files are what build.py writes."""
    before = {p.name: p.read_text() for p in xhand.FOLDER.glob("*.*") if p.suffix in (".csv", ".xml")}
    for name in before:
        shutil.copy(xhand.FOLDER / name, tmp_path / name)
    monkeypatch.setattr(xhand, "FOLDER", tmp_path)
    build.build()
    numbers = lambda text: np.array(  # noqa: E731
        [float(t) for t in text.replace('"', " ").replace(",", " ").split() if t.replace(".", "").lstrip("-").isdigit()]
    )
    for name, text in before.items():
        after = (tmp_path / name).read_text()
        assert len(after) == len(text)
        np.testing.assert_allclose(numbers(after), numbers(text), atol=2e-6)
