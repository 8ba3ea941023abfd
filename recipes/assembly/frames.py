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

# Tasks that lie flat are looked at from above; the others from the side.
_FROM_ABOVE = ("Reacher", "Swimmer")
_SIDE = {"azimuth": 90.0, "elevation": -6.0}
_ABOVE = {"azimuth": 90.0, "elevation": -90.0}
# Size of a picture's height in robot sizes, as MuJoCo computes them for the model at rest.
_DISTANCE = 2.1


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
    try:
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

        renderer = MujocoRenderer(
            plain,
            data,
            default_cam_config=_camera(plain, task),
            width=width,
            height=height,
            camera_id=-1,
        )
        pictures = []
        for position, velocity in poses:
            data.qpos[:], data.qvel[:] = position, velocity
            mujoco.mj_forward(plain, data)
            pictures.append(np.asarray(renderer.render("rgb_array")).copy())
        renderer.close()
    except Exception as error:  # each OpenGL back end fails in its own way
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RuntimeError(reason[:200]) from error
    return pictures


def _camera(model: Any, task: str) -> dict[str, Any]:
    """Follow the first body from the side, or from above."""
    flat = task.split("-")[0] in _FROM_ABOVE
    moving = model.nbody > 1
    return {
        "type": mujoco.mjtCamera.mjCAMERA_TRACKING,
        "trackbodyid": 1 if moving else 0,
        "distance": _DISTANCE * float(model.stat.extent),
        **(_ABOVE if flat else _SIDE),
    }


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
            pixels[:] = 215 + (pixels.astype(int) * 40 // 255).astype(np.uint8)
    for material in floor:
        plain.mat_reflectance[material] = 0
        plain.mat_rgba[material] = 1
    plain.vis.rgba.haze[:] = 1
    plain.vis.headlight.ambient[:] = 0.45
    return plain


def _is_plane(model: Any, geom: int) -> bool:
    return bool(model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE)
