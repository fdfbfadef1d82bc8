"""Draw pictures and films as bytes; import heavy libraries on use."""

import io
import tempfile
import zlib
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 30  # as in report figure 3.1
COLUMNS = 40  # of a heat map: windows of the training
BLACK, BLUE, ORANGE, GREEN, VERMILLION, GREY = "#000000", "#0072B2", "#E69F00", "#009E73", "#D55E00", "#999999"
PURPLE, SKY = "#CC79A7", "#56B4E9"
"""Colours that people with any colour vision tell apart (Okabe and Ito, 2008)."""


def png_of(figure: "Figure") -> bytes:
    """Return a figure as PNG; unlike `savefig`, draw it only once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)  # type: ignore[no-untyped-call]
    return buffer.getvalue()


def score_histogram(scores: Sequence[float], title: str, axis: tuple[float, float]) -> bytes:
    """Return a 256 x 256 PNG of a score distribution; scores beyond the axis are clipped to it.

    axis: both ends, the same for all pictures of a game; logarithmic if it begins above 0. Shares have a square root
        scale, which shows broad and narrow distributions.
    """
    figure, axes = _square()
    axes.hist(np.clip(scores, *axis), _edges(axis).tolist(), weights=np.full(len(scores), 1 / len(scores)), color=BLUE)
    axes.axvline(float(np.clip(np.mean(scores), *axis)), color=VERMILLION, linewidth=1.5)
    axes.set_xscale(_scale(axis))
    axes.set_xlim(*axis)
    axes.set_yscale("function", functions=(np.sqrt, np.square))
    axes.set_ylim(0, 1)
    axes.set_yticks([0, 0.05, 0.25, 0.5, 1], ["0", "5 %", "25 %", "50 %", "100 %"])
    axes.set_title(title, fontsize=8, parse_math=False)
    axes.set_xlabel(f"score (line: mean {np.mean(scores):,.0f})", fontsize=7)
    return png_of(figure)


def score_heatmap(
    ends: Sequence[int], scores: Sequence[float], length: int, unit: str, axis: tuple[float, float]
) -> bytes:
    """Return a 256 x 256 PNG of the score distribution over the training; each column's fullest bin is darkest.

    ends: of each episode, in the unit of the training's length; scores: of the same episodes.
    axis: as in `score_histogram`.
    """
    figure, axes = _square()
    counts, columns, _ = np.histogram2d(
        np.clip(ends, 0, length), np.clip(scores, *axis), (np.linspace(0, length, COLUMNS + 1), _edges(axis))
    )
    axes.pcolormesh(columns, _edges(axis), (counts / np.maximum(counts.max(axis=1, keepdims=True), 1)).T, cmap="Blues")
    axes.set_yscale(_scale(axis))
    axes.set_xlim(0, length)
    axes.set_ylim(*axis)
    axes.set_title(f"training, {len(scores):,} episodes", fontsize=8)
    axes.set_xlabel(unit, fontsize=7)
    axes.set_ylabel("score", fontsize=7)
    axes.locator_params(axis="x", nbins=4)
    axes.xaxis.get_offset_text().set_fontsize(6)
    return png_of(figure)


def scene(
    screen: npt.NDArray[np.uint8],
    lines: Sequence[str],
    source: str | None,
    actions: Sequence[str],
    chosen: int | None,
    q_values: npt.NDArray[np.float32] | None,
) -> npt.NDArray[np.uint8]:
    """Return a picture of a film: the (210, 160, 3) screen, doubled, and the decision to its right.

    An action's bar is empty for the lowest value and full for the highest. Without values there are no bars.
    """
    import cv2

    picture = np.full((420, 560, 3), 24, np.uint8)
    # Four bytes per pixel repeat as one number, ten times as fast as three.
    pixels = cv2.cvtColor(screen, cv2.COLOR_RGB2RGBA).view(np.uint32)[..., 0].repeat(2, axis=1).repeat(2, axis=0)
    cv2.cvtColor(pixels.view(np.uint8).reshape(420, 320, 4), cv2.COLOR_RGBA2RGB, dst=picture[:, :320])

    def write(text: str, x: int, y: int, colour: tuple[int, int, int] = (255, 255, 255)) -> None:
        cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)

    for row, line in enumerate(lines):
        write(line, 336, 32 + 24 * row)
    if chosen is None or source is None:
        return picture
    colour = _rgb(ORANGE if source == "random" else BLUE)
    cv2.rectangle(picture, (336, 116), (544, 148), colour, -1)
    write(f"decided by: {source}", 346, 137)
    pitch = min(52, 228 // len(actions))  # ALE has up to eighteen actions
    for index, action in enumerate(actions):
        y = 188 + pitch * index
        write(action, 336, y, (255, 255, 255) if index == chosen else (150, 150, 150))
        if q_values is not None:
            write(f"Q {q_values[index]:,.2f}", 452, y, (255, 255, 255) if index == chosen else (150, 150, 150))
            share = float(np.ptp(q_values)) and float((q_values[index] - q_values.min()) / np.ptp(q_values))
            if pitch >= 36:
                cv2.rectangle(picture, (336, y + 8), (544, y + 18), (70, 70, 70), -1)
                cv2.rectangle(picture, (336, y + 8), (336 + round(208 * share), y + 18), _rgb(GREY), -1)
        if index == chosen:
            cv2.rectangle(picture, (328, y - min(18, pitch)), (552, y + min(24, pitch // 2)), colour, 2)
    return picture


def film(pictures: Iterable[npt.NDArray[np.uint8]], frames_per_second: float) -> bytes:
    """Return an mp4 (h264, yuv420p) that browsers play, of (height, width, 3) uint8 pictures with even sides."""
    import av
    import cv2

    # In a file: faststart opens it again to move the index to the front.
    with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
        with av.open(file.name, "w", options={"movflags": "faststart"}) as container:
            rate = Fraction(frames_per_second).limit_denominator(1000)
            stream = container.add_stream("libx264", rate=rate, options={"crf": "28", "preset": "ultrafast"})
            stream.pix_fmt = "yuv420p"
            stream.thread_count = 1  # several threads take a third longer for pictures this small
            for picture in pictures:
                if not stream.codec_context.is_open:
                    stream.height, stream.width = picture.shape[:2]
                # Ten times as fast as the encoder's conversion.
                yuv = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420), np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(yuv, format="yuv420p")))
            container.mux(stream.encode())
        return Path(file.name).read_bytes()


def run_colour(player: str, sampler: str | None = None) -> str:
    """Return a run's colour as #rrggbb: the player's own, paler for samplers other than uniform."""
    own = {"cnn": BLUE, "resnet": VERMILLION, "random": GREY, "constant": BLACK}
    rest = (GREEN, ORANGE, PURPLE, SKY)
    colour = _rgb(own.get(player) or rest[zlib.crc32(player.encode()) % len(rest)])
    if sampler not in (None, "uniform"):
        colour = tuple(round(255 - 0.55 * (255 - channel)) for channel in colour)
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _edges(axis: tuple[float, float]) -> npt.NDArray[np.float64]:
    return (np.geomspace if _scale(axis) == "log" else np.linspace)(*axis, BINS + 1)


def _scale(axis: tuple[float, float]) -> str:
    return "log" if axis[0] > 0 else "linear"


def _square() -> "tuple[Figure, Axes]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.56, 2.56), dpi=100)
    axes = figure.add_axes((0.17, 0.15, 0.78, 0.77))
    axes.tick_params(labelsize=6)
    return figure, axes


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))
