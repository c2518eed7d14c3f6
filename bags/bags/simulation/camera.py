"""Render what a camera sees of a scene: ray casting, procedural textures, light and shadow."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from bags.records import CameraModel
from bags.simulation.appearance import Appearance, Floats, Kind, appearance_of, plane_axes
from bags.simulation.embree import EmbreeCaster, Nearest
from bags.simulation.sky import HAZE, Sky
from bags.simulation.textures import Patch, Textures
from lcd_common import se3
from lcd_common.errors import ConfigError

_ROWS = 47  # of a band: what is worked on at a time stays in the processor's cache
_SUN = np.array([[2.75], [2.60], [2.35]], np.float32)
_AMBIENT = np.array([[1.12], [1.22], [1.38]], np.float32)
_HAZE_M = 1400.0
_LEVEL_LIGHT = 1.75  # on level ground, in units of the exposure
_NEAR_M, _NEAR_SHADE = 2.0, np.float32(0.8)  # overcast: what is so near above takes that much
_MIDDLE, _BESIDE = np.float32(0.76), np.float32(0.12)  # of the lens's blur
_NOISE_LEVELS = 2.0  # of 255; the same at all brightnesses, as shot noise is after a square root
_LEVEL = (Kind.ROAD, Kind.PAVING, Kind.GRASS)
_UNTEXTURED = (Kind.PAINT, Kind.CAR_GLASS, Kind.PLAIN)
_MIRRORING = {Kind.WINDOW: 0.10, Kind.CAR_GLASS: 0.08, Kind.PAINT: 0.04}  # at normal incidence


@dataclass(frozen=True)
class CameraView:
    """What a camera sees, without the light.

    Attributes:
        albedo: [H x W x 3] reflectance, linear 0..1; 0 in the sky.
        depth_m: [H x W] along the optical axis; infinity in the sky.
        mover: [H x W] index of the scene's mover, -1 otherwise.
    """

    albedo: Floats
    depth_m: Floats
    mover: NDArray[np.int16]


class CameraRenderer:
    """Render frames of one scene. Same scene, pose, time and rng: same bytes."""

    def __init__(self, caster: EmbreeCaster, threads: int = 2) -> None:
        """Choose the look of every triangle.

        Args:
            caster: holds the scene.
            threads: that colour a frame; casting uses all cores.
        """
        self._caster = caster
        scene = caster.scene
        meshes = [scene.mesh, *(mover.mesh for mover in scene.movers)]
        parts = [appearance_of(scene.mesh, scene.seed)]
        for index, mover in enumerate(scene.movers):
            parts.append(appearance_of(mover.mesh, scene.seed + 1000 + index, one_object=True))
        self._first = np.cumsum([0, *(len(mesh.triangles) for mesh in meshes)]).astype(np.int32)
        # The last surface, which index -1 means, is the sky.
        nothing = np.zeros((1, 3), np.float32), np.zeros((1, 4), np.float32)
        sky = Appearance(np.zeros(1, np.uint8), *nothing, np.zeros(1, np.float32))
        self._appearance = Appearance.joined([*parts, sky])
        self._textures = Textures(scene.seed)
        self._sky = Sky(scene.light, self._textures)
        to_sun = scene.light.to_sun / np.linalg.norm(scene.light.to_sun)
        self._to_sun = to_sun.astype(np.float32)
        self._noise = np.random.default_rng(7).standard_normal(1 << 22, np.float32) * _NOISE_LEVELS
        upwards = np.random.default_rng(8).standard_normal((4099, 3), np.float32)
        upwards /= np.linalg.norm(upwards, axis=1, keepdims=True)
        upwards[:, 2] += np.float32(
            1.001
        )  # then they are spread as a diffuse surface gathers light
        self._upwards = upwards / np.linalg.norm(upwards, axis=1, keepdims=True)
        # The camera exposes by the light there is: the road is about as bright in any weather.
        light = scene.light
        self._ambient = _AMBIENT + np.float32(1.0 - light.sun) * (_AMBIENT.mean() - _AMBIENT)
        level = light.sun * max(float(self._to_sun[2]), 0.4) * _SUN + light.ambient * _AMBIENT
        wanted = _LEVEL_LIGHT * (0.75 + 0.25 * light.sun)
        self._gain = np.float32(wanted / max(float(level.mean()), 0.05))
        self._threads = ThreadPoolExecutor(threads)
        self._camera: CameraModel | None = None
        self._rays: Floats = np.empty((3, 0), np.float32)
        self._rays_of_frame: Floats = np.empty((0, 6), np.float32)

    def render(
        self,
        T_world_camera: se3.Array,
        camera: CameraModel,
        time_s: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.uint8]:
        """Return one frame [H x W x 3], RGB.

        Light is added up per colour: the sun where nothing is in its way (asked once for 2 x 2
        pixels), the sky's from above, mirrored sky in glass and paint, haze. The lens blurs by
        about half a pixel. Not modelled: light from surface to surface (in the sun, it is as dark
        below a car as in any shadow), lens flare, motion blur, a rolling shutter.

        Args:
            T_world_camera: pose of the optical frame (z ahead, x right, y down).
            camera: pinhole without distortion; pixel (0, 0) is the middle of the first one.
            time_s: where the movers are, seconds since the drive's start.
            rng: of the noise; None renders without.

        Raises:
            ConfigError: the camera has a distortion.
        """
        look = self._look(T_world_camera, camera, time_s)
        shadow = self._shadow(look, time_s)
        light = np.empty((3, camera.height, camera.width), np.float32)
        self._each_band(camera, lambda rows: self._shade(look, rows, shadow, light[:, rows]))
        frame = np.empty((camera.height, camera.width, 3), np.uint8)
        starts = None if rng is None else rng.integers(0, len(self._noise) // 2, camera.height)
        self._each_band(camera, lambda rows: self._expose(light, rows, starts, frame[rows]))
        return frame

    def view(
        self, T_world_camera: se3.Array, camera: CameraModel, time_s: float = 0.0
    ) -> CameraView:
        """Return reflectance, depth and movers of a frame; arguments as for `render`."""
        look = self._look(T_world_camera, camera, time_s)
        size = camera.height, camera.width
        albedo = np.empty((*size, 3), np.float32)

        def paint(rows: slice) -> None:
            albedo[rows] = self._albedo(look, look.part(rows)).albedo.T.reshape(albedo[rows].shape)

        self._each_band(camera, paint)
        depth = look.found.range_m * (T_world_camera[:3, 2].astype(np.float32) @ look.directions)
        return CameraView(albedo, depth.reshape(size), look.found.mover.reshape(size))

    def _look(self, T_world_camera: se3.Array, camera: CameraModel, time_s: float) -> '_Look':
        origin = T_world_camera[:3, 3].astype(np.float32)
        own, R = self._camera_rays(camera), T_world_camera[:3, :3].astype(np.float32)
        directions, rays = np.empty_like(own), self._rays_of_frame
        rays[:, :3] = origin

        def turn(rows: slice) -> None:
            pixels = slice(rows.start * camera.width, rows.stop * camera.width)
            for axis in range(3):  # three products are faster than a matrix product this thin
                turned = R[axis, 0] * own[0, pixels]
                turned += R[axis, 1] * own[1, pixels]
                turned += R[axis, 2] * own[2, pixels]
                directions[axis, pixels] = rays[pixels, 3 + axis] = turned

        self._each_band(camera, turn)
        found = self._caster.nearest_along(rays, time_s)
        which = found.triangle.copy()
        moving = np.flatnonzero(found.mover >= 0)
        which[moving] += self._first[found.mover[moving] + 1]
        into = {
            int(index): se3.inverse(self._pose(int(index), time_s)).astype(np.float32)
            for index in np.unique(found.mover[moving])
        }
        return _Look(camera, origin, directions, found, which, into)

    def _pose(self, mover: int, time_s: float) -> se3.Array:
        T = self._caster.scene.movers[mover].at(time_s)
        assert T is not None  # its rays were hit
        return T

    def _camera_rays(self, camera: CameraModel) -> Floats:
        """Return unit rays [3 x H W] in the camera's frame, kept from frame to frame."""
        if camera is self._camera:
            return self._rays
        if any(camera.distortion):
            raise ConfigError(
                f'a camera without distortion is rendered, got {camera.distortion}; '
                'rectify: leave the distortion out of the model'
            )
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
        rays = np.linalg.inv(camera.K) @ pixels
        rays /= np.linalg.norm(rays, axis=0)
        self._camera, self._rays = camera, rays.astype(np.float32)
        self._rays_of_frame = np.empty((rays.shape[1], 6), np.float32)
        return self._rays

    def _shadow(self, look: '_Look', time_s: float) -> Floats:
        """Return how much less light there is [H/2 x W/2, rounded up], 0..1.

        That is where the sun does not reach or, under an overcast sky, where level ground has
        something less than 2 m above it: a car.
        """
        height, width = look.camera.height, look.camera.width
        at = (np.arange(0, height, 2)[:, None] * width + np.arange(0, width, 2)).ravel()
        shadow = np.zeros(len(at), np.float32)
        shape = (height + 1) // 2, (width + 1) // 2
        has_sun = self._caster.scene.light.sun > 0.0
        range_m, directions = look.found.range_m[at], look.directions[:, at]
        asked = np.isfinite(range_m)
        if not has_sun:
            asked &= np.abs(look.found.normal[at, 2]) > 0.9
        ask = np.flatnonzero(asked)
        # A little back along the ray: beside the surface, on the side that is seen.
        beside = range_m[ask] * np.float32(0.9995) - np.float32(0.004)
        points = look.origin + (directions[:, ask] * beside).T
        if has_sun:
            to_sun = np.broadcast_to(self._to_sun, points.shape)
            shadow[ask] = self._caster.blocked(points, to_sun, time_s)
            return shadow.reshape(shape)
        upwards = np.resize(self._upwards, points.shape)
        shadow[ask] = self._caster.nearest(points, upwards, time_s).range_m < _NEAR_M
        return uniform_filter(shadow.reshape(shape), 5)

    def _albedo(self, look: '_Look', part: '_Part') -> '_Part':
        """Paint a part: fill in its kinds and its albedo."""
        looks, which = self._appearance, look.which[part.pixels]
        part.kind = looks.kind.take(which)
        part.albedo = np.zeros((3, len(part.kind)), np.float32)
        points, normal = part.points, part.normal
        mover = look.found.mover[part.pixels]
        if (mover >= 0).any():  # what moves is textured in its own frame
            points, normal = points.copy(), normal.copy()
            for index, T in look.into_mover.items():
                of = np.flatnonzero(mover == index)
                points[:, of] = T[:3, :3] @ points[:, of] + T[:3, 3:]
                normal[:, of] = T[:3, :3] @ normal[:, of]
        for value in np.flatnonzero(np.bincount(part.kind, minlength=len(Kind))):
            kind = Kind(int(value))
            if kind == Kind.SKY:
                continue
            of = np.flatnonzero(part.kind == value)
            own = which.take(of)
            tint = looks.tint.take(own, axis=0).T
            if kind in _UNTEXTURED:
                part.albedo[:, of] = tint
                continue
            at = points.take(of, axis=1)
            if kind in _LEVEL:
                u, v = at[0], at[1]
            else:
                axis_u, axis_v = plane_axes(normal.take(of, axis=1))
                u, v = (at * axis_u).sum(axis=0), (at * axis_v).sum(axis=0)
            extent = looks.extent.take(own, axis=0).T
            patch = Patch(u, v, part.footprint_m.take(of), tint, extent, looks.pick.take(own))
            part.albedo[:, of] = self._textures.albedo(kind, patch)
        return part

    def _shade(self, look: '_Look', rows: slice, shadow: Floats, light: Floats) -> None:
        """Write the light [3 x R x W] that comes from a band of rows."""
        part = self._albedo(look, look.part(rows))
        scene_light, width = self._caster.scene.light, look.camera.width
        behind = np.repeat(shadow[np.arange(rows.start, rows.stop) // 2], 2, axis=1)[:, :width]
        sun = self._to_sun @ part.normal
        leaves = np.flatnonzero(part.kind == Kind.LEAF)
        sun[leaves] *= np.where(sun[leaves] < 0, np.float32(-0.6), np.float32(1.0))  # shine through
        np.maximum(sun, np.float32(0.0), out=sun)
        sun *= (np.float32(1.0) - behind.ravel()) * np.float32(scene_light.sun)
        ambient = part.normal[2] * np.float32(0.38 * scene_light.ambient)
        ambient += np.float32(0.62 * scene_light.ambient)
        if scene_light.sun <= 0.0:
            ambient *= np.float32(1.0) - _NEAR_SHADE * behind.ravel()
        colour = sun * _SUN
        colour += ambient * self._ambient
        colour *= part.albedo * self._gain
        for kind, head_on in _MIRRORING.items():
            of = np.flatnonzero(part.kind == kind)
            if not len(of):
                continue
            normal, ray = part.normal.take(of, axis=1), part.directions.take(of, axis=1)
            along = (normal * ray).sum(axis=0)
            grazing = np.float32(1.0) + along
            share = head_on + np.float32(1.0 - head_on) * np.square(np.square(grazing)) * grazing
            mirrored = self._sky.colour(ray - np.float32(2.0) * along * normal)
            direct = colour.take(of, axis=1)
            colour[:, of] = direct + share * (mirrored - direct)
        haze = np.float32(1.0) - np.exp(part.range_m * np.float32(-1.0 / _HAZE_M))
        colour += haze * (HAZE - colour)
        sky = np.flatnonzero(part.kind == Kind.SKY)
        if len(sky):
            colour[:, sky] = self._sky.colour(part.directions.take(sky, axis=1))
        colour *= np.float32(scene_light.exposure)
        light[:] = colour.reshape(light.shape)

    def _expose(
        self,
        light: Floats,
        rows: slice,
        noise_starts: NDArray[np.int64] | None,
        frame: NDArray[np.uint8],
    ) -> None:
        """Write a band of the frame: the lens's blur, the tone curve, noise, 8 bits."""
        above, below = max(rows.start - 1, 0), min(rows.stop + 1, light.shape[1])
        near = light[:, above:below]
        seen = _MIDDLE * near
        seen[:, 1:] += _BESIDE * near[:, :-1]
        seen[:, :-1] += _BESIDE * near[:, 1:]
        seen = seen[:, rows.start - above : rows.stop - above]
        level = _MIDDLE * seen
        level[..., 1:] += _BESIDE * seen[..., :-1]
        level[..., :-1] += _BESIDE * seen[..., 1:]
        np.sqrt(np.maximum(level, np.float32(0.0), out=level), out=level)
        level *= np.float32(255.0)
        if noise_starts is not None:
            width = level.shape[2]
            for row, start in enumerate(noise_starts[rows]):
                level[:, row] += self._noise[start : start + 3 * width].reshape(3, width)
        np.clip(level, 0.0, 255.0, out=level)
        for channel in range(3):
            frame[..., channel] = level[channel]

    def _each_band(self, camera: CameraModel, work: Callable[[slice], None]) -> None:
        list(self._threads.map(work, _bands(camera.height)))


@dataclass
class _Part:
    """A band of pixels while it is worked on: points and normals (towards the camera) [3 x N]."""

    pixels: slice
    directions: Floats
    range_m: Floats
    points: Floats
    normal: Floats
    footprint_m: Floats
    kind: NDArray[np.uint8]
    albedo: Floats


@dataclass(frozen=True)
class _Look:
    """The rays [3 x N] of a frame and what they hit; `which` [N] indexes the appearance."""

    camera: CameraModel
    origin: Floats
    directions: Floats
    found: Nearest
    which: NDArray[np.int32]
    into_mover: dict[int, Floats]  # T_mover_world

    def part(self, rows: slice) -> _Part:
        width = self.camera.width
        pixels = slice(rows.start * width, rows.stop * width)
        directions = np.ascontiguousarray(self.directions[:, pixels])
        normal = np.ascontiguousarray(self.found.normal[pixels].T)
        range_m = self.found.range_m[pixels]
        range_m = np.where(np.isfinite(range_m), range_m, np.float32(0.0))
        cosine = (normal * directions).sum(axis=0)
        normal *= np.where(cosine > 0, np.float32(-1.0), np.float32(1.0))
        # Between what a pixel covers across and along the slanted surface.
        slanted = np.sqrt(np.maximum(np.abs(cosine), np.float32(0.02)))
        slanted *= np.float32(self.camera.K[0, 0])
        footprint = np.maximum(range_m / slanted, np.float32(1e-4))
        points = self.origin[:, None] + directions * range_m
        nothing = np.empty(0, np.uint8), np.empty((3, 0), np.float32)
        return _Part(pixels, directions, range_m, points, normal, footprint, *nothing)


def _bands(height: int) -> Iterator[slice]:
    return (slice(at, min(at + _ROWS, height)) for at in range(0, height, _ROWS))
