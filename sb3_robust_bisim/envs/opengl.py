"""Choose how MuJoCo draws without a display: EGL if its library is installed, else OSMesa."""

import ctypes.util
import glob
import importlib
import importlib.util
import os
import sys
from typing import Any

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
_SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
_chosen_before = ""  # what an earlier call wrote to MUJOCO_GL
_INSTALL = (
    "On Debian and Ubuntu install EGL with `apt-get install libegl1 libgl1 libgl1-mesa-dri` "
    "(it needs neither a GPU nor a display), or OSMesa with `apt-get install libosmesa6`"
)


def import_suite(rendering: bool) -> None:
    """
    Import Shimmy and dm_control with an OpenGL backend that this machine has. This registers the ``dm_control/...`` ids.

    The choice is stored in the variable MUJOCO_GL, which dm_control and MuJoCo read. If the user has set it, it is kept.

    :param rendering: whether frames will be drawn; otherwise OpenGL is not needed
    :raises ImportError: if a package of the extra ``dmc`` is missing
    :raises RuntimeError: if no backend works; the message names what to install
    """
    missing = [name for name in ("mujoco", "dm_control", "shimmy") if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(f"DeepMind Control needs {', '.join(missing)}: install it with `pip install sb3_robust_bisim[dmc]`")
    global _chosen_before
    chosen_here = False
    if sys.platform == "linux":
        wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
        chosen_here = wanted in ("", _chosen_before)
        if chosen_here:
            os.environ["MUJOCO_GL"] = _chosen_before = _choose_backend(rendering)
        else:
            _check_backend(wanted, rendering)
    try:
        loaded = sys.modules.get("dm_control._render")
        if chosen_here and loaded is not None and loaded.BACKEND not in _LIBRARIES and not os.environ.get("DISPLAY"):
            # dm_control was imported before and chose GLFW, which cannot draw without a display
            importlib.reload(loaded)
        import shimmy  # noqa: F401
    except (ImportError, AttributeError, RuntimeError) as error:
        # PyOpenGL raises an AttributeError if it cannot load a library
        raise _cannot_draw(error) from error


def has_gpu() -> bool:
    """Whether the system shows a graphics processor; without one, OpenGL draws on the CPU."""
    return sys.platform != "linux" or any(glob.glob(device) for device in ("/dev/dri/render*", "/dev/nvidia[0-9]*"))


def rendering_contexts(physics: Any) -> Any:
    """
    Get the OpenGL contexts of a physics. The first call creates them.

    :param physics: a dm_control physics
    :return: its contexts
    :raises RuntimeError: if the backend cannot create them; the message names what to install
    """
    try:
        return physics.contexts
    except Exception as error:  # each backend raises its own exceptions
        raise _cannot_draw(error) from error


def _cannot_draw(error: Exception) -> RuntimeError:
    backend = os.environ.get("MUJOCO_GL")
    return RuntimeError(
        f"dm_control cannot draw with MUJOCO_GL={backend}: {error}. Unset it to choose a backend automatically. {_INSTALL}"
    )


def _check_backend(wanted: str, rendering: bool) -> None:
    """
    :param wanted: the user's MUJOCO_GL
    :param rendering: see :func:`import_suite`
    :raises RuntimeError: if it disables drawing that is needed, or its library is missing
    """
    if wanted in _SWITCHED_OFF and rendering:
        raise RuntimeError(f"MUJOCO_GL={wanted} disables drawing: unset it and start the process again. {_INSTALL}")
    if wanted in _LIBRARIES and ctypes.util.find_library(_LIBRARIES[wanted]) is None:
        # The error of dm_control's import would name neither
        raise RuntimeError(f"MUJOCO_GL={wanted} needs the library lib{_LIBRARIES[wanted]}, which is missing. {_INSTALL}")


def _choose_backend(rendering: bool) -> str:
    """
    :param rendering: see :func:`import_suite`
    :return: value for MUJOCO_GL: the first backend whose library is installed
    :raises RuntimeError: if there is none, but frames will be drawn
    """
    for backend, library in _LIBRARIES.items():
        if ctypes.util.find_library(library) is not None:
            return backend
    if rendering:
        raise RuntimeError(f"Drawing frames needs OpenGL, but neither libEGL nor libOSMesa is installed. {_INSTALL}")
    return _SWITCHED_OFF[0]
