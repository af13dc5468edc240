"""Options of version 0.1.0: every one is still taken, by its name; one that is renamed takes its old name for a release."""

from __future__ import annotations

import dataclasses
import importlib
import warnings
from pathlib import Path

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.pipeline.run_config import RunConfig
from nolbo_ppl.pipeline.stage_keys import stage_settings
from nolbo_ppl.renamed_options import current_arguments, current_names, renamed_options, stored_names

OPTIONS = {
    "cli.curves:CurvesConfig": """
        out runs
    """,
    "cli.demo:DemoConfig": """
        model out seed workers
    """,
    "cli.drive:DriveConfig": """
        camera_height clutter focal frames laps look_alikes moving noise objects opposite out preset seed size step
        supersample tilt workers world
    """,
    "cli.evaluate:EvaluateConfig": """
        backgrounds batch cad count difficulty gallery least_side least_visibility model out pictures resamples
        retrieval scenes seed sizes threshold
    """,
    "cli.observe:ObserveConfig": """
        batch images intrinsics model out pictures seed size threshold
    """,
    "cli.odometry:OdometryRunConfig": """
        camera_height camera_pitch config count first images intrinsics lengths out scale truth
    """,
    "odometry:OdometryConfig": """
        cell confidence detector fast_threshold features inflation iterations largest_shift least_inliers level_factor
        levels lost_rotation_scale lost_translation_ratio parallax_share patch ratio seed still_shift threshold
    """,
    "cli.report:ReportConfig": """
        observations odometry out run_dir title truth
    """,
    "pipeline.run_config:RunConfig": """
        baseline batch camera_height camera_pitch depth depth_unit every images intrinsics keyframe_angle
        keyframe_distance loop_gap model odometry online out overlap report right seed sizes slam threshold truth
        truth_objects visual wheel
    """,
    "synthetic.scenes.scene_config:SceneConfig": """
        backgrounds blur categories clutter clutter_pixels elevation empty_probability exposure flying_probability focal
        least_box least_elevation least_visibility muted near_probability noise object_pixels objects photographs
        principal_point roll second_light_probability single_material size steep_elevation steep_probability
        sun_elevation supersample tint truncation_probability
    """,
    "cli.scenes:ScenesConfig": """
        backgrounds cad count difficulty instances out seed size workers
    """,
    "cli.slam:SlamRunConfig": """
        config model observations odometry odometry_covariance online out truth
    """,
    "inference.slam:SlamConfig": """
        annealing associator category_error category_symmetry clutter_rate constellation_log_odds constellation_minimum
        constellation_rounds constellation_size correct_scales em_iterations flip_probability latent_correlation
        latent_scale link_minimum merge_weight motion_log_odds new_rate objectness_limits odometry_rotation_scale
        odometry_translation_ratio odometry_translation_scale orientation_outlier position_ratio position_scale
        robust_width rotation_scale samples seed track_gap track_minimum
    """,
    "training.train_config:TrainConfig": """
        augment average_every backgrounds batch bf16 cache categories checkpoint_every count decode difficulty
        evaluate_every evaluate_scenes freeze grow image_size initial instance_labels latent_dim learning_rate log_every
        mirror objective optimizer orientation out preset resume scene_steps scenes seed shape_batch shape_steps
        single_count single_steps sizes symmetry tensorboard threads validation weights workers
    """,
    "cli.view:ViewerConfig": """
        browser host odometry port run_dir truth
    """,
}
"""Options by the class that holds them. Those of `SceneConfig` are keys of caches: a rename empties every cache."""


@pytest.mark.parametrize("place", OPTIONS)
def test_options_of_the_first_version_are_still_taken(place: str) -> None:
    module, name = place.split(":")
    config = getattr(importlib.import_module(f"nolbo_ppl.{module}"), name)
    known = {field.name for field in dataclasses.fields(config)}
    renamed = getattr(config, "__renamed_options__", {})
    assert set(renamed.values()) <= known and not renamed.keys() & known
    missing = set(OPTIONS[place].split()) - known - renamed.keys()
    assert not missing, "keep the old name for a release: `renamed_options`"
    for old, new in renamed.items():
        with pytest.warns(FutureWarning, match=f"`--{old}` is now `--{new.replace('_', '-')}`"):
            assert current_arguments(config, [f"--{old}", "3"]) == [f"--{new.replace('_', '-')}", "3"]


def test_a_run_takes_old_names_and_keeps_them_in_its_files(tmp_path: Path) -> None:
    """Folders of 0.1.0 say `sizes` and `every`: stages that are done stay done."""
    with pytest.warns(FutureWarning, match="RunConfig: `sizes` is now `test_sizes`"):
        config = RunConfig(images=tmp_path, out=tmp_path / "out", sizes=(96,))  # type: ignore[call-arg]
    assert config.test_sizes == (96,) and dataclasses.replace(config, frame_stride=2).test_sizes == (96,)
    with pytest.warns(FutureWarning, match="`threshold` is now `score_threshold`"):
        assert config.threshold == 0.6  # type: ignore[attr-defined]
    settings = stage_settings(config, lambda: 1)
    assert {"sizes", "threshold", "overlap"} <= settings["observe"].keys() and {"every", "wheel"} <= settings["odometry"].keys()
    assert "loop_gap" in settings["figures"] and not {"test_sizes", "min_loop_gap"} & set().union(*settings.values())


def test_settings_of_slam_keep_their_old_names_in_files(tmp_path: Path) -> None:
    """The key of the stage of SLAM is that of 0.1.0, so that a map that is done stays done."""
    with pytest.warns(FutureWarning, match="SlamConfig: `new_rate` is now `birth_intensity`"):
        config = SlamConfig(new_rate=0.3, clique_window=9)  # type: ignore[call-arg]
    assert config.birth_intensity == 0.3
    settings = stage_settings(RunConfig(images=tmp_path, out=tmp_path / "out", slam=config), lambda: 1)["slam"]["slam"]
    assert settings["new_rate"] == 0.3 and settings["constellation_size"] == 9 and settings["clutter_rate"] is None
    assert not {"birth_intensity", "clique_window", "equality_minimum"} & settings.keys()
    with pytest.warns(FutureWarning, match=r"--slam\.constellation-rounds` is now `--slam\.clique-rounds"):
        assert current_arguments(RunConfig, ["--slam.constellation-rounds", "2"]) == ["--slam.clique-rounds", "2"]


@renamed_options(gap="min_gap")
@dataclasses.dataclass(frozen=True)
class Inner:
    min_gap: int = 1
    width: float = 2.0


@renamed_options(draw="pictures")
@dataclasses.dataclass(frozen=True)
class Outer:
    pictures: bool = True
    inner: Inner = Inner()
    other: Inner | None = None


def test_nested_options_and_switches() -> None:
    with pytest.warns(FutureWarning):
        found = current_arguments(Outer, ["--no-draw", "--inner.gap=4", "--other.gap", "5", "gap"])
    assert found == ["--no-pictures", "--inner.min-gap=4", "--other.min-gap", "5", "gap"]
    stored = {"draw": True, "inner": {"gap": 3, "width": 2.0}, "other": None}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert current_arguments(Outer, found) == found
        present = dataclasses.asdict(Outer(inner=Inner(3)))
        assert stored_names(Outer(), present) == stored
        assert current_names(Outer, stored) == present == current_names(Outer, present)


def test_an_option_by_both_of_its_names_is_refused() -> None:
    for args, given in (((), {"gap": 1, "min_gap": 2}), ((2,), {"gap": 1})):
        with pytest.raises(InputError, match="Inner: `gap` and `min_gap` are one option"):
            Inner(*args, **given)
    for line in (["--inner.min-gap", "6", "--inner.gap=4"], ["--inner.gap", "4", "--inner.min_gap=6"]):
        with pytest.raises(InputError, match=r"`--inner\.gap` and `--inner\.min-gap` are one option"):
            current_arguments(Outer, line)
    with pytest.raises(InputError, match="`--draw` and `--pictures` are one option"):
        current_arguments(Outer, ["--no-draw", "--pictures"])
    with pytest.raises(InputError, match="`gap` and `min_gap` are one option"):
        current_names(Outer, {"inner": {"gap": 1, "min_gap": 1}})
    with pytest.warns(FutureWarning):  # all fields of the old value are given then, and none of them by the caller
        assert dataclasses.replace(Inner(1, 3.0), gap=5) == Inner(5, 3.0)  # type: ignore[call-arg]
