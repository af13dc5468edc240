"""The online system in a file: what is loaded goes on as what was saved."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nolbo_ppl.data.simulate import SimulatedSequence, WorldConfig, simulate_circuit, simulate_sequence
from nolbo_ppl.errors import InputError
from nolbo_ppl.geometry.pose import inverse, se3_exp
from nolbo_ppl.inference.slam import IncrementalSlam, SlamConfig, SlamProblem
from nolbo_ppl.io.npz import Npz, save_npz

CONFIG = SlamConfig(odometry_rotation_scale=0.004, odometry_translation_ratio=0.01, latent_correlation=0.2)


@pytest.fixture(scope="module")
def halfway(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatedSequence, IncrementalSlam, Path]:
    rng = np.random.default_rng(2)
    truth = simulate_circuit(rng, laps=2, radius=20.0, frames_per_lap=50)
    drive = simulate_sequence(truth, rng, world=WorldConfig(objects=20, categories=5, latent_dim=4))
    table = drive.observations
    slam = IncrementalSlam(CONFIG, SlamProblem(drive.odometry[:50], table.select(table.frame < 50)))
    for t in range(81):  # one stretch is condensed, those that explored its place wait
        slam.update(drive.odometry[t], table.select(table.frame == t))
    path = tmp_path_factory.mktemp("online") / "state.npz"
    slam.save(path)
    return drive, slam, path


def test_what_is_loaded_goes_on_bit_for_bit(halfway: tuple[SimulatedSequence, IncrementalSlam, Path]) -> None:
    drive, slam, path = halfway
    with Npz(path) as archive:  # settings under the names that files of 0.1.0 have
        assert "new_rate" in json.loads(str(archive.array("meta", (), kinds="U")))["config"]
    again, table = IncrementalSlam.load(path), drive.observations
    assert slam.keeper.waiting and slam.keeper.explored and slam.keeper.condensed
    for t in range(81, 100):
        rows = table.select(table.frame == t)
        one, other = slam.update(drive.odometry[t], rows), again.update(drive.odometry[t], rows)
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        assert (one.landmarks, one.closings, one.met, one.keyframes) == (
            other.landmarks,
            other.closings,
            other.met,
            other.keyframes,
        )
    np.testing.assert_array_equal(slam.trajectory(), again.trajectory())
    for a, b in zip(slam.landmarks(), again.landmarks(), strict=True):
        assert a.existence == b.existence and a.class_posterior == b.class_posterior and a.index == b.index
        np.testing.assert_array_equal(a.covariance, b.covariance)
        np.testing.assert_array_equal(a.latent_variance, b.latent_variance)
    np.testing.assert_array_equal(np.concatenate(slam.assigned), np.concatenate(again.assigned))
    assert slam.tables[-1].category == again.tables[-1].category


def test_files_of_another_kind_are_refused(halfway: tuple[SimulatedSequence, IncrementalSlam, Path], tmp_path: Path) -> None:
    _, _, path = halfway
    with pytest.raises(InputError, match="no such"):
        IncrementalSlam.load(tmp_path / "absent.npz")
    other = tmp_path / "other.npz"
    save_npz(other, {"a": np.zeros(3)})
    with pytest.raises(InputError, match=r"other\.npz"):
        IncrementalSlam.load(other)
    with Npz(path) as archive:
        arrays = {name: archive.array(name, kinds="fiubU", finite=False) for name in archive.names}
    meta = json.loads(str(arrays["meta"]))
    hanging, factors = arrays["graph/attached"].copy(), arrays["graph/factor"].copy()
    hanging[0, 1] = hanging[0, 0]  # hangs on itself
    factors[3, 2] = 10**6
    meta["keyframes"]["stretch"] = 0

    def told(**changes: object) -> np.ndarray:
        return np.array(json.dumps(json.loads(str(arrays["meta"])) | changes))

    changed = (
        ("graph/T", arrays["graph/T"][:-1]),
        ("graph/attached", hanging),
        ("graph/factor", factors),
        ("graph/covariance", -arrays["graph/covariance"]),
        ("landmark/votes", arrays["landmark/votes"][:, :-1]),
        ("landmark/place", arrays["landmark/place"] + 10**6),
        ("landmark/number", arrays["landmark/number"] + 10**6),
        ("tracker/mean", arrays["tracker/mean"][:, :2]),
        ("prior/mean", np.array([np.nan])),
        ("meta", np.array("{}")),
        ("meta", told(frames=10**7)),
        ("meta", told(keyframes=meta["keyframes"])),
        ("meta", told(loops=meta["loops"] | {"merged": [[0, 1], [1, 0]]})),
        ("meta", told(keeper=meta["keeper"] | {"explored": [10**12]})),
        ("meta", told(drift=meta["drift"] | {"standing": [99] * len(meta["drift"]["standing"])})),
    )
    for name, value in changed:
        save_npz(other, arrays | {name: value})
        with pytest.raises(InputError, match=r"other\.npz"):
            IncrementalSlam.load(other)
    with pytest.raises(InputError, match="no keyframe"):
        IncrementalSlam().save(other)


def test_the_map_of_yesterday_is_the_prior_of_today(halfway: tuple[SimulatedSequence, IncrementalSlam, Path]) -> None:
    """Another drive round the same objects from a pose known to 0.7 m and 3 degrees, its odometry in a frame of its own."""
    drive, _, path = halfway
    slam, table = IncrementalSlam.load(path), drive.observations
    before, rng = len(slam.landmarks()), np.random.default_rng(5)
    scale = np.repeat([0.05, 0.7], 3)
    slam.begin(drive.truth[20] @ se3_exp(scale * rng.normal(size=6)), np.diag(scale**2))
    with pytest.raises(InputError, match="no keyframe yet"):
        slam.save(path.with_name("begun.npz"))
    met = 0
    for t in range(20, 70):
        info = slam.update(inverse(drive.odometry[20]) @ drive.odometry[t], table.select(table.frame == t))
        met += info.met
    assert info.frame == 130 and met >= 10 and info.landmarks <= 1.1 * before
    assert np.linalg.norm(info.T_world_camera[:3, 3] - drive.truth[69, :3, 3]) < 0.6
    assert slam.trajectory().shape == (131, 4, 4)
    with pytest.raises(InputError, match="several drives"):
        slam.finish()
    slam.save(path.with_name("twice.npz"))
    again = IncrementalSlam.load(path.with_name("twice.npz"))
    np.testing.assert_array_equal(again.trajectory(), slam.trajectory())
    with pytest.raises(InputError, match="no pose"):
        slam.begin(np.zeros((4, 4)), np.eye(6))
