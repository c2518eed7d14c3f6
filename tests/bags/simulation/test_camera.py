"""Camera frames: what is seen where, by hand-made geometry; light, shadow and textures."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from bags.records import CameraModel
from bags.simulation.camera import CameraRenderer
from bags.simulation.embree import EmbreeCaster
from bags.simulation.scene import Light, Mover, Scene
from bags.street.mesh import Label, Material, Mesh, MeshBuilder
from lcd_common import se3
from lcd_common.errors import ConfigError

CAMERA = CameraModel(
    'camera', 320, 120, np.array([[180.0, 0, 155.5], [0, 180.0, 58.25], [0, 0, 1]])
)
R_WORLD_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along world x
HEIGHT_M = 1.65
BOX_AT, BOX_SIZE, BOX_YAW = np.array([12.0, 1.5, 1.5]), (2.0, 3.0, 3.0), 0.4


def camera_at(x: float, y: float, z: float = HEIGHT_M, yaw: float = 0.0) -> se3.Array:
    """Return T_world_camera, looking along x turned by yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return se3.from_rotation_translation(turn @ R_WORLD_CAMERA, [x, y, z])


def box(
    at: np.ndarray, size: tuple[float, float, float], yaw: float, material: Material, label: Label
) -> Mesh:
    mesh = MeshBuilder()
    mesh.label = label
    mesh.box(at, size, yaw, material)
    return mesh.build()


def ground(with_box: bool = False, material: Material = Material.ASPHALT) -> Mesh:
    """A level road, 400 m long, and a box on it if wanted."""
    mesh = MeshBuilder()
    mesh.label = Label.ROAD
    mesh.quads(
        np.array([[[-200, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0.0]]]), material
    )
    if with_box:
        mesh.label = Label.BUILDING
        mesh.box(BOX_AT, BOX_SIZE, BOX_YAW, Material.PLASTER)
    return mesh.build()


def project(xyz: np.ndarray, T_world_camera: se3.Array) -> np.ndarray:
    """Return pixels [N x 2] of world points [N x 3] by the textbook's formula."""
    p = (xyz - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    return (p @ CAMERA.K.T)[:, :2] / p[:, 2:]


def box_corners() -> np.ndarray:
    c, s = np.cos(BOX_YAW), np.sin(BOX_YAW)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return signs * 0.5 * BOX_SIZE @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + BOX_AT


def renderer(*movers: Mover, mesh: Mesh, light: Light | None = None) -> CameraRenderer:
    return CameraRenderer(EmbreeCaster(Scene(mesh, movers, light or Light(), seed=4)))


def from_hull(corners: np.ndarray) -> np.ndarray:
    """Return how far each pixel lies outside the convex hull of points [N x 2], in pixels."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    sides = ConvexHull(corners).equations
    return (np.stack([u, v], -1) @ sides[:, :2].T + sides[:, 2]).max(axis=-1)


def test_silhouette_of_a_box_is_that_of_its_projected_corners():
    T = camera_at(0.0, 0.0, yaw=0.1)
    only_box = box(BOX_AT, BOX_SIZE, BOX_YAW, Material.PLASTER, Label.BUILDING)
    render = renderer(mesh=only_box)
    outside = from_hull(project(box_corners(), T))
    seen = np.isfinite(render.view(T, CAMERA).depth_m)
    assert seen[outside < -0.01].all() and not seen[outside > 0.01].any()
    # In the frame, plaster differs from the sky; the lens's blur reaches one pixel.
    frame = render.render(T, CAMERA).astype(float)
    beside = np.abs(frame[outside > 2.0][:, 2].min() - frame[outside < -2.0][:, 2].max())
    assert beside > 10.0


def test_depth_of_a_plane_is_what_its_equation_says():
    T = camera_at(3.0, -2.0, yaw=0.7)
    depth = renderer(mesh=ground()).view(T, CAMERA).depth_m
    rows = np.arange(80, CAMERA.height)
    expected = HEIGHT_M / ((rows - CAMERA.K[1, 2]) / CAMERA.K[1, 1])
    np.testing.assert_allclose(
        depth[rows], np.repeat(expected[:, None], CAMERA.width, 1), rtol=1e-4
    )


def test_same_rng_same_bytes():
    T = camera_at(0.0, 0.0)
    frames = [
        renderer(mesh=ground(True)).render(T, CAMERA, 0.0, np.random.default_rng(seed))
        for seed in (5, 5, 6)
    ]
    assert frames[0].dtype == np.uint8 and frames[0].shape == (120, 320, 3)
    np.testing.assert_array_equal(frames[0], frames[1])
    noise = frames[0].astype(float) - frames[2]
    assert 1.0 < noise.std() / np.sqrt(2) < 4.0


def test_shadow_lies_where_rays_to_the_sun_meet_the_box():
    to_sun = np.array([0.5, 0.45, 0.6])
    light = Light(to_sun=to_sun, sun=1.0, ambient=0.3)
    T = camera_at(0.0, -2.0)
    render = renderer(mesh=ground(True), light=light)
    view, frame = render.view(T, CAMERA), render.render(T, CAMERA).astype(float).sum(axis=2)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(CAMERA.K).T
    depth = np.where(np.isfinite(view.depth_m), view.depth_m, 0.0)
    points = (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]
    on_ground = (np.abs(points[..., 2]) < 0.01) & (depth > 0) & (depth < 40)
    # Slabs of the box, in its own axes.
    c, s = np.cos(BOX_YAW), np.sin(BOX_YAW)
    into_box = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    start, along = (points - BOX_AT) @ into_box.T, into_box @ to_sun
    sides = np.stack([(sign * 0.5 * np.array(BOX_SIZE) - start) / along for sign in (-1, 1)])
    enters, leaves = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    shadow = (leaves > enters) & (leaves > 0)
    dark = frame < 0.5 * (
        np.median(frame[on_ground & shadow]) + np.median(frame[on_ground & ~shadow])
    )
    assert 200 < (on_ground & shadow).sum() < 0.5 * on_ground.sum()
    assert (dark == shadow)[on_ground].mean() > 0.97
    ratio = np.median(frame[on_ground & shadow]) / np.median(frame[on_ground & ~shadow])
    assert ratio < 0.75


def test_overcast_sky_casts_no_shadow_but_it_is_dark_below_things():
    overcast = Light(sun=0.0, ambient=0.5)
    T = camera_at(0.0, 0.0)
    lifted = MeshBuilder()
    lifted.label = Label.CAR
    lifted.box(np.array([8.0, 0.0, 0.9]), (4.0, 3.0, 0.6), 0.0, Material.METAL)
    road = ground()
    both = Mesh(
        np.concatenate([road.vertices, lifted.build().vertices]),
        np.concatenate([road.triangles, lifted.build().triangles + np.uint32(len(road.vertices))]),
        np.concatenate([road.materials, lifted.build().materials]),
        np.concatenate([road.labels, lifted.build().labels]),
    )
    with_box, without = (
        renderer(mesh=mesh, light=overcast).render(T, CAMERA).astype(float) for mesh in (both, road)
    )
    below = project(np.array([[6.2, 1.0, 0.0], [6.2, -1.0, 0.0]]), T).round().astype(int)
    aside = project(np.array([[8.0, 4.5, 0.0], [8.0, -4.5, 0.0]]), T).round().astype(int)
    (left, row), (right, _) = below
    dark = with_box[row, left:right].mean() / without[row, left:right].mean()
    assert dark < 0.85
    for column, line in aside:
        np.testing.assert_array_equal(
            with_box[line - 1 : line + 2, column - 1 : column + 2],
            without[line - 1 : line + 2, column - 1 : column + 2],
        )


def sliding(material: Material = Material.METAL, label: Label = Label.CAR) -> Mover:
    """A box that moves 4 m to the left in 2 s."""
    mesh = box(np.array([0.0, 0.0, 1.0]), (1.5, 2.0, 2.0), 0.0, material, label)
    poses = np.stack([se3.from_rotation_translation(np.eye(3), [9.0, y, 0.0]) for y in (-2.0, 2.0)])
    return Mover(mesh, np.array([1.0, 3.0]), poses)


@pytest.mark.parametrize(('time_s', 'y'), [(1.0, -2.0), (1.5, -1.0), (3.0, 2.0)])
def test_mover_is_seen_where_it_is(time_s, y):
    T = camera_at(0.0, 0.0)
    seen = renderer(sliding(), mesh=ground()).view(T, CAMERA, time_s).mover
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    outside = from_hull(project(signs * [0.75, 1.0, 1.0] + [9.0, y, 1.0], T))
    assert (seen[outside < -0.01] == 0).all() and (seen[outside > 0.01] == -1).all()


def test_mover_is_gone_outside_its_times():
    render = renderer(sliding(), mesh=ground())
    assert (render.view(camera_at(0.0, 0.0), CAMERA, 3.1).mover == -1).all()


def test_sky_is_bright_and_blue_where_nothing_is():
    T = camera_at(0.0, 0.0)
    render = renderer(mesh=ground())
    view, frame = render.view(T, CAMERA), render.render(T, CAMERA).astype(float)
    assert np.isinf(view.depth_m[:58]).all() and (view.albedo[:58] == 0.0).all()
    assert frame[:40].mean() > 1.3 * frame[80:].mean()
    assert frame[:40, :, 2].mean() > frame[:40, :, 0].mean() + 10.0


def same_points(a, b, points_in_b) -> float:
    """Return the correlation of the albedo in view a with that of the same points in view b."""
    pixel = np.round(points_in_b).astype(int)
    inside = (pixel >= 0).all(-1) & (pixel < [CAMERA.width, CAMERA.height]).all(-1)
    inside &= np.isfinite(a.depth_m)
    pixel = pixel[inside]
    one, other = a.albedo[inside].sum(-1), b.albedo[pixel[:, 1], pixel[:, 0]].sum(-1)
    assert len(one) > 1000 and one.std() > 0.05 * one.mean()
    return float(np.corrcoef(one, other)[0, 1])


@pytest.mark.parametrize('material', [Material.BRICK, Material.PLASTER, Material.WOOD])
def test_texture_of_a_wall_stays_on_it(material):
    wall = MeshBuilder()
    wall.label = Label.BUILDING
    wall.quads(np.array([[[4.0, -9, -3], [4.0, 9, -3], [4.0, 9, 6], [4.0, -9, 6]]]), material)
    render = renderer(mesh=wall.build())
    here, there = camera_at(1.5, 0.0), camera_at(1.55, 0.4, 1.7, yaw=0.1)
    a, b = (render.view(T, CAMERA) for T in (here, there))
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(CAMERA.K).T
    points = (rays * a.depth_m[..., None]) @ here[:3, :3].T + here[:3, 3]
    pixels = project(points.reshape(-1, 3), there).reshape(*u.shape, 2)
    moved = same_points(a, b, pixels)
    shifted = same_points(a, b, pixels + np.array([23.0, 0.0]))
    # Which of two texels a pixel takes differs between the views, never which wall.
    assert moved > 0.6 and moved > shifted + 0.4


def test_texture_of_a_mover_goes_with_it():
    render = renderer(sliding(Material.BRICK, Label.TRUCK), mesh=ground())
    T = camera_at(6.5, 0.0)
    a, b = (render.view(T, CAMERA, time_s) for time_s in (2.0, 2.1))
    # 0.2 m to the left at 1.75 m: the face that is seen.
    pixels = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), -1).astype(
        float
    )
    pixels[..., 0] -= 0.2 * CAMERA.K[0, 0] / 1.75
    pixels[a.mover < 0] = -1.0
    assert same_points(a, b, pixels) > 0.6


def test_each_car_has_one_colour_and_cars_differ():
    meshes = MeshBuilder()
    meshes.label = Label.CAR
    for k in range(12):
        meshes.box(np.array([12.0, 3.0 * k - 16.5, 0.7]), (4.0, 1.8, 0.7), 0.0, Material.METAL)
        meshes.box(np.array([12.2, 3.0 * k - 16.5, 1.5]), (2.0, 1.5, 0.1), 0.0, Material.METAL)
    render = renderer(mesh=meshes.build())
    T = camera_at(0.0, 0.0, z=4.0)
    view = render.view(T, CAMERA)
    colours = set()
    for k in range(3, 9):
        at = np.array([[10.0, 3.0 * k - 16.5, 0.9], [11.2, 3.0 * k - 16.5, 1.5]])
        u, v = np.round(project(at, T)).astype(int).T
        body, roof = view.albedo[v, u]
        np.testing.assert_array_equal(body, roof)
        colours.add(tuple(body))
    assert len(colours) > 3


def test_distorted_camera_is_refused():
    bent = CameraModel('camera', 320, 120, CAMERA.K, (0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match='without distortion'):
        renderer(mesh=ground()).render(camera_at(0.0, 0.0), bent)
