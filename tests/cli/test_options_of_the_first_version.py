"""Options of version 0.1.0: every one is still taken, by its name; one that is renamed takes its old name for a release."""

from __future__ import annotations

import dataclasses
import importlib

import pytest

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
    known = {field.name for field in dataclasses.fields(getattr(importlib.import_module(f"nolbo_ppl.{module}"), name))}
    missing = set(OPTIONS[place].split()) - known
    assert not missing, "keep the old name for a release, with a FutureWarning"
