"""Pictures of a robot in given poses, drawn off-screen on white."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from training.console import say

# Tasks that lie flat are looked at from above; the others from the side.
_FROM_ABOVE = ("Reacher", "Swimmer")
_SIDE, _ABOVE = -5.0, -90.0  # elevation of the camera, degrees
_FAR = 0.9999  # depth of what is not there, 1 at the far end of the scene
_ROOM = 1.45  # distance of the camera in heights of what has to fit


def render_poses(
    model: Any,
    task: str,
    poses: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    *,
    width: int,
    height: int,
) -> list[NDArray[np.uint8]]:
    """Draw a robot in each pose.

    Args:
        model: the MuJoCo model; left as it is.
        task: Gymnasium id.
        poses: positions and velocities of the simulator.
        width: of a picture, pixels.
        height: of a picture, pixels.

    Returns:
        Pictures, each ``(height, width, 3)``.

    Raises:
        RuntimeError: if nothing can be drawn on this machine; the message says why.
    """
    if sys.platform.startswith("linux"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # no display is needed
    plain = _on_white(model)
    data = mujoco.MjData(plain)
    extent, middle = _extent_at_rest(plain, data)
    flat = task.split("-")[0] in _FROM_ABOVE
    # What lies flat turns: its longest side has to fit in both directions.
    across, upward = (extent.max(), extent.max()) if flat else (extent[0], extent[2])
    size = max(float(upward), float(across) * height / width)
    # MuJoCo draws no picture larger than its buffer.
    plain.vis.global_.offwidth = max(plain.vis.global_.offwidth, width)
    plain.vis.global_.offheight = max(plain.vis.global_.offheight, height)
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX in plain.tex_type
    try:
        from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

        viewer = OffScreenViewer(plain, data, width, height)
        camera = viewer.cam
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.distance, camera.azimuth = _ROOM * size, 90.0
        camera.elevation = _ABOVE if flat else _SIDE
        pictures = []
        for position, velocity in poses:
            data.qpos[:], data.qvel[:] = position, velocity
            mujoco.mj_forward(plain, data)
            # Along with the robot, but not up and down with it: the ground stays where it is.
            camera.lookat[:] = (*_center(data)[:2], middle)
            picture = np.array(viewer.render("rgb_array"))
            if not sky:
                picture[np.asarray(viewer.render("depth_array")) >= _FAR] = 255
            pictures.append(picture)
        viewer.close()  # type: ignore[no-untyped-call]
    except Exception as error:  # each OpenGL back end fails in its own way
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RuntimeError(reason[:200]) from error
    return pictures


def _center(data: Any) -> NDArray[np.float64]:
    """Return the centre of mass of everything that moves."""
    return np.asarray(data.subtree_com[0]).copy()


def _extent_at_rest(model: Any, data: Any) -> tuple[NDArray[np.float64], float]:
    """Return the extent (x, y, z) of the robot's initial pose and the middle of its height, m."""
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    moving = np.asarray(model.geom_bodyid) > 0
    radius = np.asarray(model.geom_rbound)[moving, None]
    low = (np.asarray(data.geom_xpos)[moving] - radius).min(0)
    high = (np.asarray(data.geom_xpos)[moving] + radius).max(0)
    return high - low, float((high + low)[2] / 2)


def _on_white(model: Any) -> Any:
    """Return a copy of a model with a white sky and a light floor, for a page that is white."""
    plain = copy.copy(model)
    floor = {int(plain.geom_matid[i]) for i in range(plain.ngeom) if _is_plane(plain, i)} - {-1}
    textures = {int(t) for material in floor for t in plain.mat_texid[material].ravel() if t >= 0}
    for texture in range(plain.ntex):
        start = int(plain.tex_adr[texture])
        size = int(
            plain.tex_width[texture] * plain.tex_height[texture] * plain.tex_nchannel[texture]
        )
        pixels = plain.tex_data[start : start + size]
        if plain.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            pixels[:] = 255
        elif texture in textures:
            pixels[:] = 165 + (pixels.astype(int) * 45 // 255).astype(np.uint8)
    for material in floor:
        plain.mat_reflectance[material] = 0
        plain.mat_rgba[material] = 1
    plain.vis.rgba.haze[:] = 1
    plain.vis.headlight.ambient[:] = 0.45
    return plain


def _is_plane(model: Any, geom: int) -> bool:
    return bool(model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE)


def render_or_say(
    model: Any,
    task: str,
    poses: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    **size: int,
) -> list[NDArray[np.uint8]]:
    """Draw a robot in each pose, or say in one line why that can't be done here.

    Args:
        model: see :func:`render_poses`, as are the others.
        task: name of the task.
        poses: positions and velocities.
        **size: width and height.

    Returns:
        The pictures; none where off-screen rendering fails.
    """
    try:
        return render_poses(model, task, poses, **size)
    except RuntimeError as error:
        say(f"no pictures of the robot, off-screen rendering failed: {error}")
        return []
