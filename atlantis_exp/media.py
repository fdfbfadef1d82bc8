"""Pictures and films of what happened, as bytes; heavy libraries are imported where they draw."""

import io
import tempfile
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt

SCORE_RANGE = (1e3, 1e6)  # the axis of every histogram, so that runs and steps can be laid side by side
BINS = 30  # as in report figure 3.1


def score_histogram(scores: Sequence[float], title: str) -> bytes:
    """A PNG, 256 x 256, of a score distribution on a fixed logarithmic axis; scores beyond it stand at its ends."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.56, 2.56), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    edges = np.geomspace(*SCORE_RANGE, BINS + 1)
    axes.hist(np.clip(scores, *SCORE_RANGE), bins=edges.tolist(), color="#1f77b4")
    axes.axvline(float(np.clip(np.mean(scores), *SCORE_RANGE)), color="#d62728", linewidth=1)
    axes.set_xscale("log")
    axes.set_xlim(*SCORE_RANGE)
    axes.set_ylim(0, None)
    axes.set_title(title, fontsize=8)
    axes.set_xlabel(f"score (red: mean {np.mean(scores):,.0f})", fontsize=7)
    axes.tick_params(labelsize=6)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def film(screens: Iterable[npt.NDArray[np.uint8]], frames_per_second: float) -> bytes:
    """An mp4 (h264, yuv420p, twice the screen's size) that browsers play, of (height, width, 3) uint8 screens."""
    import av

    # A file, since the second pass, which puts the index first so that a browser starts at once, opens it again.
    with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
        with av.open(file.name, "w", options={"movflags": "faststart"}) as container:
            rate = Fraction(frames_per_second).limit_denominator(1000)
            stream = container.add_stream("libx264", rate=rate, options={"crf": "28", "preset": "veryfast"})
            stream.pix_fmt = "yuv420p"
            for screen in screens:
                if not stream.codec_context.is_open:
                    stream.height, stream.width = 2 * screen.shape[0], 2 * screen.shape[1]
                doubled = screen.repeat(2, axis=0).repeat(2, axis=1)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(doubled, format="rgb24")))
            container.mux(stream.encode())
        return Path(file.name).read_bytes()
