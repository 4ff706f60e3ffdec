"""Films two agents of a study side by side: one with counterfactuals, one without.

``python watch.py study=demo`` writes ``<root>/studies/demo/watch.gif``, and ``.mp4`` if
FFmpeg is there. Both sides show the same test start of the study's task, whatever comes
of it, with the policies whose test results the study reports.

Further arguments:

- ``methods``: the two sides, ``[none,caiac]`` by default
- ``task``: another task; by default that of the study's answer, or the first one
- ``episode``: which test start of the task, from 0; by default 0
- ``settings``, ``learners``, ``seeds``: of the run, by default the first that has both
- ``root``, ``size=quick``: as for ``study.py``
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from environments.playing import Recording
from evaluate import evaluate
from shared.console import Console
from shared.parts import candidates, make_environment, make_method, policy_file
from shared.studies import Run
from study import Options, read_arguments
from torchrl_caiac._figures import name_label
from torchrl_caiac._files import whole_file
from train import load_policy

__all__ = ["film", "pair", "read_watch_arguments", "record", "write_gif", "write_mp4"]

_STRIP = 40  # pixels of the labels
_FRAME = 0.08  # seconds; a GIF counts in hundredths
_MOVING, _STILL = 86, 12  # frames at most, then the last one again: 8 seconds
_MAX_BYTES = 3_000_000


def read_watch_arguments(
    arguments: Sequence[str],
) -> tuple[Options, str | None, int]:
    """Returns the arguments of ``study.py`` with two methods, the task, the episode.

    Raises:
        ValueError: an argument is not known or has a wrong value.
        FileNotFoundError: there is no such study.
    """
    own = {"task": "", "episode": "0"}
    rest = []
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name in own:
            own[name] = value
        else:
            rest.append(argument)
    if not own["episode"].isdecimal():
        raise ValueError(f"episode is {own['episode']!r}, expected a number from 0")
    if not any(a.startswith("study=") for a in rest):
        raise ValueError("study=NAME is missing, for example study=demo")
    if not any(a.startswith("methods=") for a in rest):
        rest.append("methods=[none,caiac]")
    options = read_arguments(rest)
    if len(options.only["methods"]) != 2:
        raise ValueError(
            f"methods are {options.only['methods']}, expected two, one for each side"
        )
    task = own["task"] or options.study.answer.task or None
    return options, task, int(own["episode"])


def pair(options: Options) -> list[Run]:
    """Returns the first runs of the study that differ in the two methods alone.

    Raises:
        ValueError: there are none.
    """
    methods = options.only["methods"]
    sides: dict[tuple[str, str, int], dict[str, Run]] = {}
    for run in filter(options.wanted, options.study.runs()):
        same = sides.setdefault((run.setting, run.learner, run.seed), {})
        same[run.method] = run
        if len(same) == 2:
            return [same[method] for method in methods]
    raise ValueError(
        f"the study {options.study.name} has no two such runs that differ in the "
        f"methods {methods} alone: choose others with methods=, settings=, learners= "
        "and seeds="
    )


def record(run: Run, task: str | None, episode: int = 0) -> Recording:
    """Returns an episode of the policy whose test results are reported.

    Raises:
        FileNotFoundError: the run has not been trained, or not here.
    """
    steps = candidates(run.cfg)
    files = [policy_file(run.cfg, run.method, run.seed, step) for step in steps]
    if not all(file.exists() for file in files):
        raise FileNotFoundError(
            f"the policies of {run} are not in {files[0].parent}: train them with "
            "study.py, with the same study and root"
        )
    *_, test = evaluate(run.cfg, run.method, run.seed)
    actor = load_policy(run.cfg, run.method, run.seed, test.step)
    return make_environment(run.cfg).record(actor, run.seed, task, episode=episode)


def film(recordings: Sequence[Recording], labels: Sequence[str]) -> list[Image.Image]:
    """Returns the frames of a video in which the episodes run side by side.

    It is faster than the simulation if that takes longer than seven seconds. An episode
    that is over stays as it ended.
    """
    lengths = [len(recording.states) for recording in recordings]
    seconds = (max(lengths) - 1) * recordings[0].seconds
    number = min(_MOVING, max(2, 1 + round(seconds / _FRAME)))
    times = np.linspace(0, max(lengths) - 1, number).round().astype(int)
    panels = []
    for recording, length, label in zip(recordings, lengths, labels, strict=True):
        shown = np.minimum(times, length - 1)
        rows, where = np.unique(shown, return_inverse=True)
        frames = recording.render(recording.states[rows])[where]
        panels.append(
            [
                _labelled(frame, label, _state(recording, time, length))
                for frame, time in zip(frames, times, strict=True)
            ]
        )
    images = [
        Image.fromarray(np.concatenate(row, axis=1))
        for row in zip(*panels, strict=True)
    ]
    return images + images[-1:] * _STILL


def _state(recording: Recording, time: int, length: int) -> str:
    text = f"{name_label(recording.task)}, step {min(time, length - 1)}"
    if time < length - 1:
        return text
    return f"{text}: " + ("solved" if recording.success else "not solved")


def _labelled(frame: np.ndarray, label: str, state: str) -> np.ndarray:
    """Returns a frame below a strip of text."""
    strip = Image.new("RGB", (frame.shape[1], _STRIP), "white")
    draw = ImageDraw.Draw(strip)
    draw.text((6, 3), label, "black", ImageFont.load_default(15))
    draw.text((6, 21), state, "dimgray", ImageFont.load_default(13))
    return np.concatenate([np.asarray(strip), frame])


def write_gif(path: Path, images: Sequence[Image.Image]) -> None:
    """Writes a GIF of at most 3 MB, with as many colours as fit.

    Raises:
        ValueError: it is larger with 16 colours too.
    """
    for colours in (128, 64, 32, 16):
        # One palette of all frames: other ones flicker.
        sheet = np.concatenate(
            [np.asarray(image) for image in images[:: 1 + len(images) // 6]]
        )
        palette = Image.fromarray(sheet).quantize(colours)
        reduced = [
            image.quantize(palette=palette, dither=Image.Dither.NONE)
            for image in images
        ]
        with whole_file(path) as partial:
            reduced[0].save(
                partial,
                format="GIF",
                save_all=True,
                append_images=reduced[1:],
                duration=round(1000 * _FRAME),
                loop=0,
            )
        if path.stat().st_size <= _MAX_BYTES:
            return
    raise ValueError(f"{path} has {path.stat().st_size} bytes, more than {_MAX_BYTES}")


def write_mp4(path: Path, images: Sequence[Image.Image]) -> str | None:
    """Writes an MP4 with FFmpeg.

    Returns:
        str, optional: why it was not written.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        return "no ffmpeg was found"
    width, height = images[0].size
    with whole_file(path) as partial:
        command: list[Any] = [program, "-y", "-loglevel", "error"]
        command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
        command += ["-r", 1 / _FRAME, "-i", "-", "-pix_fmt", "yuv420p"]
        command += ["-f", "mp4", partial]
        pixels = b"".join(image.tobytes() for image in images)
        done = subprocess.run(
            list(map(str, command)), input=pixels, capture_output=True
        )
        if done.returncode:
            raise RuntimeError(f"ffmpeg failed: {done.stderr.decode().strip()}")
    return None


def watch(options: Options, task: str | None, episode: int, console: Console) -> None:
    """Films two runs, and prints the files."""
    runs = pair(options)
    with console.stage("episodes"):
        recordings = [record(run, task, episode) for run in runs]
    labels = []
    for run in runs:
        method = make_method(run.cfg, run.method)
        labels.append(vars(type(method)).get("label", "") or run.method)
    with console.stage("frames"):
        images = film(recordings, labels)
    with console.stage("video"):
        files = [options.folder / f"watch.{kind}" for kind in ("gif", "mp4")]
        write_gif(files[0], images)
        missing = write_mp4(files[1], images)
    if missing:
        console.print(f"left out: {files.pop()} ({missing})")
    console.print(
        f"test start {episode} of seed {runs[0].seed}: {', '.join(map(str, files))}"
    )


def main(arguments: Sequence[str]) -> None:
    """Films two agents of the study of the arguments."""
    options, task, episode = read_watch_arguments(arguments)
    with Console(options.folder, stages=3) as console:
        watch(options, task, episode, console)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (ValueError, FileNotFoundError, RuntimeError) as error:
        sys.exit(f"error: {error}")
