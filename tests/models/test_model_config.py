"""Configurations: presets, round trips, refusals."""

from __future__ import annotations

import json
from typing import Any

import pytest

from nolbo_ppl.errors import InputError
from nolbo_ppl.models.model_config import PRESETS, ModelConfig
from nolbo_ppl.models.observation_model import Nolbo
from tests.factories import instance_config, tiny_config


def test_presets_survive_json() -> None:
    for make in (*PRESETS.values(), instance_config):
        config = make()
        again = ModelConfig.from_json(json.loads(json.dumps(config.to_json())))
        assert again == config
        assert hash(again) == hash(config)


def test_presets_are_what_they_say() -> None:
    tiny, paper = PRESETS["tiny"](), PRESETS["paper"]()
    assert tiny.stride == 16 and paper.stride == 32
    assert paper.voxel_size == 64 and paper.encoder == "darknet19"
    assert len(tiny.categories) == 12
    assert tiny.category_dim == 16 and tiny.instance_dim == 0
    assert (instance_config().category_dim, instance_config().instance_dim) == (2, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"symmetry": (1, 1)}, "one symmetry per category"),
        ({"categories": ("car",) * 4}, "category names must be unique"),
        ({"categories": (), "symmetry": ()}, "category names must be unique"),
        ({"instances": ("a", "b"), "instance_category": (0,)}, "one category per instance"),
        ({"instances": ("a",), "instance_category": (7,)}, "category of an instance"),
        ({"instances": ("a",), "instance_category": (-1,)}, "category of an instance"),
        ({"instances": ("a",), "instance_category": (0,), "latent_dim": 5}, "even latent_dim"),
        ({"image_size": 100}, "multiple of 32"),
        ({"image_size": 0}, "multiple of 32"),
        ({"decoder_channels": (8, 4)}, "decoder_channels do not reach"),
        ({"voxel_encoder_channels": (8, 4)}, "voxel_encoder_channels do not reach"),
        ({"objectness_epsilon": 0.0}, "objectness_epsilon"),
        ({"objectness_epsilon": 0.7}, "objectness_epsilon"),
        ({"orientation": "angle", "azimuth_components": 4}, "has one azimuth mode"),
        ({"azimuth_components": 0}, "azimuth_components"),
    ],
)
def test_refusals(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        tiny_config(**changes)


def test_unknown_fields_are_named() -> None:
    with pytest.raises(InputError, match=r"unknown fields of a model configuration: got \['latent'\]"):
        ModelConfig.from_json({"latent": 3})


def test_networks_depend_on_the_seed_only() -> None:
    import torch

    torch.manual_seed(0)
    a = Nolbo.from_seed(tiny_config(), 3)
    after = torch.rand(1)
    torch.manual_seed(0)
    torch.rand(5)
    b, c = Nolbo.from_seed(tiny_config(), 3), Nolbo.from_seed(tiny_config(), 4)
    torch.manual_seed(0)
    assert torch.equal(torch.rand(1), after), "the caller's generator is left as it was"
    for (name, x), y in zip(a.state_dict().items(), b.state_dict().values(), strict=True):
        assert torch.equal(x, y), name
    assert not torch.equal(c.guide.head.objectness.weight, a.guide.head.objectness.weight)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("glimpse_blocks", 10**9),
        ("encoder_blocks", [1, 10**9, 1]),
        ("encoder_blocks", [1, 1]),
        ("latent_dim", 16.0),
        ("latent_dim", True),
        ("latent_dim", "16"),
        ("latent_dim", 10**400),
        ("latent_dim", None),
        ("head_width", 0),
        ("max_concentration", float("nan")),
        ("max_concentration", -1.0),
        ("box_scale", 1e300),
        ("box_loc", [0, 0, "0", 0]),
        ("categories", "chair"),
        ("categories", [1, 2]),
        ("encoder", "huge"),
        ("voxel_size", 48),
        ("voxel_patches", 1),
        ("orientation", ["mixture"]),
    ],
)
def test_values_of_other_types_or_sizes_are_refused_by_name(name: str, value: object) -> None:
    values = {**ModelConfig().to_json(), name: value}
    with pytest.raises(InputError, match=name):
        ModelConfig.from_json(values)
    with pytest.raises(InputError, match="model configuration"):
        ModelConfig.from_json([values])  # type: ignore[arg-type]
