"""The facts of Atlantis, with the files `atlantis_*` next to this one.

Three guns defend a city. ALE counts each standing building, guns included, as a life; it can rise again. A gun fires
once a press, so a held action fires once.
"""

from collections.abc import Sequence

_WAVE_STATE, _WAVE_OVER = 0x53, 2  # a byte of the console's memory, and its value from the bonus to the next wave


class Atlantis:
    """This package's game.

    The centre gun scores 100 for a vessel and 1,000 for a bomber, a side gun twice as much. The end of a wave scores
    500 for each standing building, in one frame.
    """

    actions = ("NOOP", "FIRE", "RIGHTFIRE", "LEFTFIRE")  # FIRE is the gun in the middle
    score_range = (1e3, 1e6)
    episode_steps = 2_000  # in `Atlantis-v0`; a good player plays many times longer
    sources = ("centre_vessel", "side_vessel", "centre_bomber", "side_bomber", "wave_bonus")
    sources_in_words = (
        "vessels and bombers, each hit by the centre gun or a side gun, and the bonus for standing buildings at the "
        "end of a wave"
    )
    random_score = 12_850.0
    human_score = 29_028.1
    published_in_words = "above a million the time cap decides"
    held_score = 2_000.0
    early_frames = 10_000_000
    early_scores = "at 5 M frames published DQN is at 7,000 to 9,000"
    keys = (("left", "LEFTFIRE"), ("right", "RIGHTFIRE"), ("up", "FIRE"), ("space", "FIRE"))
    keys_in_words = "left, up, right fire a gun each; a gun fires once a press"

    @staticmethod
    def points(reward: int, ram: Sequence[int]) -> Sequence[float]:
        """Split a frame's reward by `sources`; `ram` is the console's, 128 bytes, after the frame."""
        if ram[_WAVE_STATE] == _WAVE_OVER:
            return 0, 0, 0, 0, reward
        bombers, vessels = divmod(reward // 100, 10)  # the centre gun hits at most once a frame
        return vessels % 2 * 100, vessels // 2 * 200, bombers % 2 * 1_000, bombers // 2 * 2_000, 0
