"""How MuJoCo draws without a display: EGL where its library is installed, else OSMesa."""

import ctypes.util
import importlib
import importlib.util
import os
import sys
from typing import Any

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
_SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
_INSTALL = (
    "On Debian and Ubuntu install EGL with `apt-get install libegl1 libgl1 libgl1-mesa-dri` "
    "(it needs neither a GPU nor a display), or OSMesa with `apt-get install libosmesa6`"
)


def import_suite(rendering: bool) -> None:
    """
    Import Shimmy and dm_control, which registers the ``dm_control/...`` ids, with an OpenGL backend that this machine has.

    The choice is left in the variable MUJOCO_GL, which dm_control and MuJoCo read. A value that the user set is kept.

    :param rendering: whether frames will be drawn; without them a machine that lacks OpenGL will do
    :raises ImportError: when a package of the extra ``dmc`` is missing
    :raises RuntimeError: when no backend works, with what to install
    """
    missing = [name for name in ("mujoco", "dm_control", "shimmy") if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(f"DeepMind Control needs {', '.join(missing)}: install it with `pip install sb3_robust_bisim[dmc]`")
    chosen_here = False
    if sys.platform == "linux":
        wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
        _check_backend(wanted, rendering)
        chosen_here = not wanted
        if chosen_here:
            os.environ["MUJOCO_GL"] = _choose_backend(rendering)
    try:
        loaded = sys.modules.get("dm_control._render")
        if chosen_here and loaded is not None and loaded.BACKEND not in _LIBRARIES and not os.environ.get("DISPLAY"):
            # The user imported dm_control first, which then took GLFW: that cannot draw without a display
            importlib.reload(loaded)
        import shimmy  # noqa: F401
    except (ImportError, AttributeError, RuntimeError) as error:
        # PyOpenGL reports a library that it cannot load as an AttributeError
        raise _cannot_draw(error) from error


def rendering_contexts(physics: Any) -> Any:
    """
    Get the OpenGL contexts of a physics, which it makes when it is first asked.

    :param physics: a dm_control physics
    :return: its contexts
    :raises RuntimeError: when the backend cannot make them, with what to install
    """
    try:
        return physics.contexts
    except Exception as error:  # each backend has exceptions of its own
        raise _cannot_draw(error) from error


def _cannot_draw(error: Exception) -> RuntimeError:
    backend = os.environ.get("MUJOCO_GL")
    return RuntimeError(f"dm_control cannot draw with MUJOCO_GL={backend}: {error}. Unset it to choose by itself. {_INSTALL}")


def _check_backend(wanted: str, rendering: bool) -> None:
    """
    :param wanted: the user's MUJOCO_GL
    :param rendering: see :func:`import_suite`
    :raises RuntimeError: when it switches off what is needed, or its library is missing
    """
    if wanted in _SWITCHED_OFF and rendering:
        raise RuntimeError(f"MUJOCO_GL={wanted} switches drawing off: start a process where it is unset. {_INSTALL}")
    if wanted in _LIBRARIES and ctypes.util.find_library(_LIBRARIES[wanted]) is None:
        # dm_control's import would fail with a message that names neither
        raise RuntimeError(f"MUJOCO_GL={wanted} asks for the library lib{_LIBRARIES[wanted]}, which is missing. {_INSTALL}")


def _choose_backend(rendering: bool) -> str:
    """
    :param rendering: see :func:`import_suite`
    :return: value for MUJOCO_GL: the first backend whose library is installed
    :raises RuntimeError: when there is none, but frames are to be drawn
    """
    for backend, library in _LIBRARIES.items():
        if ctypes.util.find_library(library) is not None:
            return backend
    if rendering:
        raise RuntimeError(f"Drawing frames needs OpenGL, but neither libEGL nor libOSMesa is installed. {_INSTALL}")
    return _SWITCHED_OFF[0]
