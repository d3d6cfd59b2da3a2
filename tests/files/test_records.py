"""Every result as a document and back, bit for bit; what is no such document is refused in one line."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import json
import pkgutil
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
import result_samples
from small_scenes import camera, scene, texture, wall

import mitsuba_crb
from mitsuba_crb import se3
from mitsuba_crb.agents.tiles import Budget
from mitsuba_crb.bound.cramer_rao import PoseBound
from mitsuba_crb.errors import DocumentError, FrameError, MitsubaCRBError
from mitsuba_crb.files import Record
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.information.image_jacobian import ImageJacobian
from mitsuba_crb.information.linearisation import Linearised

SAMPLES = list(result_samples.samples())


def named(sample: Record) -> str:
    return type(sample).__name__


def through_json(record: Record) -> Any:
    return json.loads(json.dumps(record.to_dict(), allow_nan=False))


def assert_same(a: Any, b: Any, where: str) -> None:
    """Equal in type and in every bit; not-a-number is one number, whatever its sign."""
    if isinstance(a, np.generic):
        a = a.item()
    if isinstance(a, Mapping):
        a = dict(a)
    assert type(a) is type(b), where
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape) == (b.dtype, b.shape), where
        numbers = ~np.isnan(a)
        np.testing.assert_array_equal(numbers, ~np.isnan(b), where)
        assert a[numbers].tobytes() == b[numbers].tobytes(), where
    elif isinstance(a, dict):
        assert list(a) == list(b), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key!r}]")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for k, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}[{k}]")
    else:
        assert repr(a) == repr(b), where


@pytest.mark.parametrize("sample", SAMPLES, ids=named)
def test_a_result_comes_back_bit_for_bit(sample: Record) -> None:
    document = through_json(sample)
    assert (document["type"], document["schema"]) == (named(sample), 1)
    back = type(sample).from_dict(document)
    assert_same(sample, back, named(sample))
    assert through_json(back) == document


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (0.1, np.nextafter(0.1, 1.0).item()),
        (0.0, -0.0),
        (1, True),
        (1, 1.0),
        ((1,), [1]),
        ({"a": 1}, {"b": 1}),
        (np.zeros(2), -np.zeros(2)),
        (np.zeros(2), np.zeros(2, dtype=np.float32)),
        (np.zeros((0, 6)), np.zeros((0, 4))),
        (np.array([np.nan, 1.0]), np.array([1.0, np.nan])),
        (Budget(tiles=1), Budget(tiles=2)),
    ],
)
def test_the_comparison_sees_a_bit(a: Any, b: Any) -> None:
    """Negative control."""
    assert_same(a, a, "itself")
    with pytest.raises(AssertionError):
        assert_same(a, b, "others")


def test_every_class_that_can_be_written_has_a_sample() -> None:
    for module in pkgutil.walk_packages(mitsuba_crb.__path__, "mitsuba_crb."):
        importlib.import_module(module.name)
    classes: set[type] = set()
    waiting: list[type] = [Record]
    while waiting:
        cls = waiting.pop()
        waiting += cls.__subclasses__()
        classes |= {cls} if cls.__module__.startswith("mitsuba_crb.") else set()
    assert {cls.__name__ for cls in classes - {Record, Linearised}} == {named(sample) for sample in SAMPLES}


def test_every_public_function_returns_what_can_be_written() -> None:
    public = {name: getattr(mitsuba_crb, name) for name in mitsuba_crb.__all__}
    returned = {
        name: value.__annotations__["return"]
        for name, value in public.items()
        if callable(value) and not isinstance(value, type)
    }
    assert returned.pop("load_scene") == "mi.Scene"
    assert returned.pop("load_world") == "dict[str, Any]"
    assert returned.pop("pose_bounds") == "list[PoseBound]"
    assert returned.pop("measure_field") == returned.pop("open_field") == "ViewField"  # is a store already
    assert len(returned) > 10
    assert set(returned.values()) <= {named(sample) for sample in SAMPLES}


class TestWhatFollows:
    """From what came back, the same follows as from the original."""

    @pytest.mark.parametrize("name", result_samples.bounds(np.random.default_rng(0)))
    def test_a_bound(self, name: str) -> None:
        bound = result_samples.bounds(np.random.default_rng(0))[name]
        back = PoseBound.from_dict(through_json(bound))
        for frame in ("camera", "world"):
            assert_same(bound.to_frame(frame), back.to_frame(frame), frame)
        assert_same(bound.ellipsoid("position"), back.ellipsoid("position"), "ellipsoid")
        assert_same(bound.optimality, back.optimality, "optimality")
        if bound.joint is not None and back.joint is not None:
            assert_same(bound.joint.fix().information, back.joint.fix().information, "nuisances known")

    def test_an_information_of_the_world_frame_goes_back_to_the_camera_s_without_losing_digits(self) -> None:
        camera = result_samples.information(np.random.default_rng(1))
        back = FisherInformation.from_dict(through_json(camera.to_frame("world")))
        assert_same(camera, back.to_frame("camera"), "camera")
        moved = back.transform(np.eye(6), variable=back.variable, frame="world", pose=back.pose)
        assert not np.allclose(moved.to_frame("camera").matrix, camera.matrix, rtol=1e-9)

    def test_a_pose_that_is_rounded_once_is_not_rounded_again(self) -> None:
        rng = np.random.default_rng(2)
        for _ in range(200):
            rough = se3.exp(rng.normal(size=6)).astype(np.float32)
            information = result_samples.information(rng, pose=rough)
            back = FisherInformation.from_dict(through_json(information))
            assert back.pose.tobytes() == information.pose.tobytes()
            assert not back.pose.flags.writeable

    @pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")
    def test_a_rendered_bound_and_its_jacobian(self) -> None:
        world = scene(wall=wall(texture()), camera=camera(16, 12))
        options: dict[str, Any] = {"spp": 8, "seed": 1}
        bound = mitsuba_crb.pose_bound(world, nuisances=["gain", "black:8"], **options)
        assert bound.provenance
        assert_same(bound, PoseBound.from_dict(through_json(bound)), "bound")
        jacobian = mitsuba_crb.pose_jacobian(world, **options)
        back = ImageJacobian.from_dict(through_json(jacobian))
        assert_same(jacobian, back, "jacobian")
        noise = mitsuba_crb.noise.Gaussian(0.01)
        mine, its = (mitsuba_crb.fisher_information(each, noise) for each in (jacobian, back))
        assert_same(mine, its, "information")


def document_of() -> dict[str, Any]:
    found = through_json(result_samples.information(np.random.default_rng(3)).to_frame("world"))
    assert isinstance(found, dict)
    return found


JUNK: list[Any] = [None, True, -1, 2.5, "nan", "x", [], [1], [[1.0, 2.0]], {}, {"type": "array"}, 10**400]


def random_way(rng: np.random.Generator, document: Any) -> Iterator[tuple[Any, Any]]:
    """Tables or lists and keys, from the document down to some value in it."""
    while document and isinstance(document, dict | list):
        keys = list(document) if isinstance(document, dict) else range(len(document))
        key = keys[rng.integers(len(keys))]
        yield document, key
        document = document[key]


class TestRefusals:
    @pytest.mark.parametrize(
        ("path", "value", "message"),
        [
            ("type", "PoseBound", "has the type 'PoseBound', not 'FisherInformation'"),
            ("schema", 2, "has the schema 2, not 1"),
            ("matrix", None, "FisherInformation.matrix must be a table, not None"),
            ("matrix/values", [1.0] * 35, "matrix has 35 values, which do not fill the shape (6, 6)"),
            ("matrix/shape", [-6, -6], "do not fill the shape (-6, -6)"),
            ("matrix/shape", [True, 36], "matrix.shape must be a whole number, not True"),
            ("matrix/values", ["1.0"] * 36, "some of its values are no float64 numbers"),
            ("matrix/values", [[1.0]] * 36, "some of its values are no float64 numbers"),
            ("matrix/dtype", "int64", "some of its values are no int64 numbers"),
            ("matrix/dtype", "object", "some of its values are no object numbers"),
            ("matrix/dtype", "number", "is no array of numbers: data type 'number' not understood"),
            (
                "linearisation/frame",
                "body",
                "linearisation.frame must be one of 'camera', 'world', not 'body'",
            ),
            ("linearisation/length_scale", True, "linearisation.length_scale must be a number, not True"),
            ("linearisation/variable", 3, "linearisation.variable must be a text, not 3"),
            ("linearisation/selection/total", 1.5, "selection.total must be a whole number, not 1.5"),
            ("_origin/linearisation/pose/values", [], "_origin.linearisation.pose has 0 values"),
            ("note", "", "has an unknown key 'note'"),
        ],
    )
    def test_a_damaged_document_in_one_line_that_names_the_place(
        self, path: str, value: Any, message: str
    ) -> None:
        document = document_of()
        FisherInformation.from_dict(document)
        *way, last = path.split("/")
        table = document
        for step in way:
            table = table[step]
        table[last] = value
        with pytest.raises(DocumentError, match=re.escape(message)) as caught:
            FisherInformation.from_dict(document)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("sample", SAMPLES, ids=named)
    def test_any_missing_key_even_of_a_field_with_a_default(self, sample: Record) -> None:
        for key in sample.to_dict():
            document = sample.to_dict()
            del document[key]
            with pytest.raises(DocumentError, match="has no" if key not in ("type", "schema") else "None"):
                type(sample).from_dict(document)

    @pytest.mark.parametrize("sample", SAMPLES, ids=named)
    def test_any_damage_is_refused_as_such_or_read(self, sample: Record) -> None:
        rng = np.random.default_rng(4)
        for _ in range(15):
            document = through_json(sample)
            *_, (table, key) = random_way(rng, document)
            table[key] = JUNK[rng.integers(len(JUNK))]
            with contextlib.suppress(MitsubaCRBError):
                type(sample).from_dict(document)

    @pytest.mark.parametrize("document", [None, [], "PoseBound", 3, {}])
    def test_what_is_no_document(self, document: Any) -> None:
        with pytest.raises(DocumentError, match="PoseBound"):
            PoseBound.from_dict(document)

    def test_values_that_the_class_refuses_itself(self) -> None:
        document = document_of()
        document["linearisation"]["length_scale"] = "inf"
        with pytest.raises(FrameError, match="positive and finite"):
            FisherInformation.from_dict(document)

    def test_a_prior_that_is_damaged_names_its_place(self) -> None:
        document = through_json(result_samples.bounds(np.random.default_rng(0))["prior information"])
        document["inverse"]["prior"]["matrix"]["values"].pop()
        with pytest.raises(DocumentError, match=re.escape("inverse.prior.matrix has 35 values")):
            PoseBound.from_dict(document)

    @pytest.mark.parametrize("odd", [object(), 1j, np.array([1j]), np.array([None]), {"x": {1, 2}}])
    def test_what_json_cannot_hold_is_not_written(self, odd: Any) -> None:
        bound = result_samples.bounds(np.random.default_rng(0))["plain"]
        bound = dataclasses.replace(bound, provenance={"odd": odd})
        with pytest.raises(MitsubaCRBError, match="cannot write"):
            bound.to_dict()
