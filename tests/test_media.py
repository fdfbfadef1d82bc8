"""Pictures and films, decoded again."""

import io

import av
import cv2
import numpy as np
import numpy.typing as npt
import pytest

from atlantis_exp.media import film, score_histogram


def pixels(png: bytes) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)


def test_a_histogram_is_a_png_of_256_by_256_pixels() -> None:
    png = score_histogram([2_000.0, 8_000.0, 62_500.0], "episodes 1-3")
    assert png.startswith(b"\x89PNG")
    assert pixels(png).shape == (256, 256, 3)


def bars(png: bytes) -> npt.NDArray[np.intp]:
    """Columns of the picture that a bar (colour #1f77b4) touches."""
    return np.flatnonzero((pixels(png) == (0x1F, 0x77, 0xB4)).all(axis=2).any(axis=0))


def test_a_score_stands_in_the_same_column_whatever_else_is_drawn() -> None:
    alone = bars(score_histogram([10_000.0] * 3, "x"))
    among = bars(score_histogram([10_000.0] * 3 + [100_000.0] * 3, "x"))
    assert alone.size > 0
    assert set(alone.tolist()) - {alone.min(), alone.max()} <= set(among.tolist())
    assert among.max() > alone.max() + 20


def test_scores_beyond_the_axis_stand_at_its_ends() -> None:
    assert score_histogram([100.0], "x").startswith(b"\x89PNG")
    low, high = bars(score_histogram([0.0] * 2, "x")), bars(score_histogram([4e6] * 2, "x"))
    assert 0 < low.max() < high.min()


def top_level_boxes(mp4: bytes) -> list[str]:
    boxes, at = [], 0
    while at < len(mp4):
        size = int.from_bytes(mp4[at : at + 4])
        boxes.append(mp4[at + 4 : at + 8].decode("latin-1"))
        at += size
    return boxes


@pytest.fixture(scope="module")
def mp4() -> bytes:
    screens = [np.full((210, 160, 3), level, np.uint8) for level in range(0, 240, 8)]
    return film(screens, 20.0)


def test_a_film_holds_every_screen_as_h264_that_browsers_play(mp4: bytes) -> None:
    with av.open(io.BytesIO(mp4), "r") as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.height, stream.width) == (420, 320)
        assert stream.average_rate == 20
    assert len(frames) == 30
    for level, frame in zip(range(0, 240, 8), frames, strict=True):
        assert abs(float(frame.mean()) - level) < 4


def test_a_films_index_comes_before_its_pictures_so_that_a_browser_starts_at_once(mp4: bytes) -> None:
    boxes = top_level_boxes(mp4)
    assert boxes.index("moov") < boxes.index("mdat")
