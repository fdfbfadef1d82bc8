"""Pictures and films, decoded again."""

import io

import av
import cv2
import numpy as np
import numpy.typing as npt
import pytest

from atlantis_exp.media import BLUE, ORANGE, film, run_colour, scene, score_heatmap, score_histogram

AXIS = (1e3, 1e6)


def pixels(png: bytes) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)


def test_a_histogram_is_a_png_of_256_by_256_pixels() -> None:
    png = score_histogram([2_000.0, 8_000.0, 62_500.0], "episodes 1-3", AXIS)
    assert png.startswith(b"\x89PNG")
    assert pixels(png).shape == (256, 256, 3)


def bars(png: bytes) -> npt.NDArray[np.intp]:
    """Columns of the picture that a bar touches."""
    return np.flatnonzero(coloured(pixels(png), BLUE).any(axis=0))


def coloured(picture: npt.NDArray[np.uint8], colour: str) -> npt.NDArray[np.bool_]:
    return np.asarray((picture == tuple(bytes.fromhex(colour[1:]))).all(axis=2))


def test_a_score_stands_in_the_same_column_whatever_else_is_drawn() -> None:
    alone = bars(score_histogram([10_000.0] * 3, "x", AXIS))
    among = bars(score_histogram([10_000.0] * 3 + [100_000.0] * 3, "x", AXIS))
    assert alone.size > 0
    assert set(alone.tolist()) - {alone.min(), alone.max()} <= set(among.tolist())
    assert among.max() > alone.max() + 20


def test_scores_beyond_the_axis_stand_at_its_ends() -> None:
    assert score_histogram([100.0], "x", AXIS).startswith(b"\x89PNG")
    low, high = bars(score_histogram([0.0] * 2, "x", AXIS)), bars(score_histogram([4e6] * 2, "x", AXIS))
    assert 0 < low.max() < high.min()


def test_a_share_stands_as_high_whatever_else_is_drawn() -> None:
    def height(scores: list[float]) -> int:
        return int(coloured(pixels(score_histogram(scores, "x", AXIS)), BLUE).sum(axis=0).max())

    assert height([10_000.0] * 4) == height([10_000.0] * 400) > 100
    half = height([10_000.0] * 2 + [100_000.0] * 2)
    assert half / height([10_000.0] * 4) == pytest.approx(0.5**0.5, abs=0.02)


def test_a_heat_map_grows_to_the_right_on_axes_that_stay() -> None:
    def dark(png: bytes) -> npt.NDArray[np.intp]:
        picture = pixels(png).astype(int)
        return np.flatnonzero(((picture[..., 2] - picture[..., 0] > 60) & (picture[..., 2] > 60)).any(axis=0))

    early = dark(score_heatmap([1, 2], [2_000.0, 3_000.0], 100, "episodes", AXIS))
    late = dark(score_heatmap([1, 2, 99], [2_000.0, 3_000.0, 90_000.0], 100, "episodes", AXIS))
    assert pixels(score_heatmap([1], [2_000.0], 100, "episodes", AXIS)).shape == (256, 256, 3)
    assert set(early.tolist()) < set(late.tolist())
    assert late.max() - early.max() > 150


def test_a_scene_shows_who_decided_and_how_the_values_compare() -> None:
    screen = np.full((210, 160, 3), 200, np.uint8)
    q_values = np.array([0.0, 1.0, 2.5, 5.0], np.float32)
    chance = scene(screen, ("step 1",), "random", ("A", "B", "C", "D"), 1, q_values)
    network = scene(screen, ("step 1",), "network", ("A", "B", "C", "D"), 3, q_values)
    assert chance.shape == (420, 560, 3)
    assert (chance[:, :320] == 200).all()
    assert coloured(chance, ORANGE).sum() > 1_000 < coloured(network, BLUE).sum()
    assert not coloured(chance, BLUE).any()
    grey = (0x99, 0x99, 0x99)
    lengths = [int((network[y + 12, 336:545] == grey).all(axis=1).sum()) for y in (188, 240, 292, 344)]
    assert [round(length / lengths[3], 1) for length in lengths] == [0.0, 0.2, 0.5, 1.0]
    without = scene(screen, ("step 1",), "constant player", ("A", "B", "C", "D"), 1, None)
    assert not (without[200, 336:545] == grey).all(axis=1).any()


def test_colours_are_those_of_the_network_paler_where_another_sampler_is_used() -> None:
    colours = [run_colour(model, sampler) for model in ("cnn", "resnet") for sampler in ("uniform", "top_half")]
    assert colours[0] == BLUE.lower()
    assert len(set(colours)) == 4
    assert run_colour("cnn", "top_half") == colours[1]
    assert sum(bytes.fromhex(colours[1][1:])) > sum(bytes.fromhex(colours[0][1:]))
    assert run_colour("another") == run_colour("another", "uniform")


def top_level_boxes(mp4: bytes) -> list[str]:
    boxes, at = [], 0
    while at < len(mp4):
        size = int.from_bytes(mp4[at : at + 4])
        boxes.append(mp4[at + 4 : at + 8].decode("latin-1"))
        at += size
    return boxes


@pytest.fixture(scope="module")
def mp4() -> bytes:
    pictures = [np.full((420, 320, 3), level, np.uint8) for level in range(0, 240, 8)]
    return film(pictures, 20.0)


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
