"""Depth cameras and grey ones: the derivative of z, which pixels measure, and under which noise."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flow_scenes import GREY, LENSES, SMALL_LENSES, THIN_LENS, mesh
from matrices import misfit
from numpy.typing import NDArray
from small_scenes import T, camera, mi, scene, textured_wall, wall

from mitsuba_crb import Intrinsics, check_jacobian, pose_bound, pose_jacobian, se3
from mitsuba_crb.cli import app as cli
from mitsuba_crb.errors import NoiseError, OptionError, SensorError
from mitsuba_crb.information.fisher import FisherInformation
from mitsuba_crb.jacobian import view_term
from mitsuba_crb.measure.options import MeasurementKeywords
from mitsuba_crb.measure.poses import pose_table
from mitsuba_crb.measure.sensing import parse_depth_sigma, parse_range
from mitsuba_crb.noise import Gaussian, SigmaPower, SigmaTable, Stereo
from mitsuba_crb.render.film import PixelFilter
from mitsuba_crb.render.view import open_view

# Few samples on small images: that standard errors exceed 10 % is expected.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_crb.errors.PrecisionWarning")

SIGMA = 0.01
DEPTH: MeasurementKeywords = {"measure": "depth", "depth_sigma": SIGMA, "batches": 8}
BOX = {
    "type": "cube",
    "to_world": T().translate([0.3, 0.2, 2.4]).rotate([1, 1, 0], 30).scale(0.3),
    "bsdf": GREY,
}


def slanted() -> dict[str, Any]:
    """A plane, 15 degrees off the optical axis."""
    return scene(wall=wall(), sensor=camera(24, 18, target=(0.6, 0.5, 3)))


def information(world: Any, **options: Any) -> FisherInformation:
    return image_alone(pose_bound(world, **{**DEPTH, "spp": 64, **options}))


def image_alone(bound: Any) -> FisherInformation:
    return bound.joint.information


def closed_form(world: Any, lens: Intrinsics | None = None) -> NDArray[np.float64]:
    """F of a plane n·p = c: its depth at a film point with the ray z s is c/(n·s), which moves by

    dz/dξ = (n·ṗ)/(n·s),   ṗ = −ρ − φ×p;   averaged over the filter by a sum over its whole support.
    """
    with open_view(world, camera=lens) as view:
        pose, eye, h = view.pose, view.camera, PixelFilter.of(view.sensor.film().rfilter())
        width, height = view.size
    steps = (np.arange(32) + 0.5) / 32 * 2 * h.radius - h.radius
    weight = h.interpolate(np.stack([steps, steps], axis=-1))[:, 0]
    weight = np.outer(weight, weight) / weight.sum() ** 2
    normal = pose[:3, :3].T @ [0.0, 0.0, 1.0]
    distance = 3.0 - pose[2, 3]
    F = np.zeros((6, 6))
    for row in range(height):
        for column in range(width):
            u, v = np.meshgrid(column + 0.5 + steps, row + 0.5 + steps)
            film = np.stack([u, v], axis=-1)
            s = eye.directions(film.reshape(-1, 2)).reshape(32, 32, 3)
            s /= s[..., 2:]
            slant = s @ normal
            p = s * (distance / slant)[..., None]
            columns = -np.concatenate([np.broadcast_to(normal, p.shape), np.cross(p, normal)], axis=-1)
            J = np.einsum("yx,yxk->k", weight, columns / slant[..., None])
            F += np.outer(J, J) / SIGMA**2
    return F


@pytest.mark.parametrize(("method", "spp"), [("flow", 256), ("forward", 64), ("finite_difference", 64)])
def test_information_of_a_plane_is_that_of_the_closed_form(method: str, spp: int) -> None:
    found, expected = information(slanted(), method=method, spp=spp), closed_form(slanted())
    error = np.abs(found.matrix - expected) / np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    allowed = np.maximum(0.01, 3 * found.standard_error / np.sqrt(np.outer(*2 * [np.diag(expected)])))
    assert (error < allowed).all(), error
    assert (np.diag(found.standard_error) < 0.03 * np.diag(expected)).all()


@pytest.mark.parametrize("lens", SMALL_LENSES)
def test_information_of_a_plane_through_a_lens_is_that_of_the_closed_form(lens: str) -> None:
    """Not without the lens: that would be off by more than what is allowed."""
    small = SMALL_LENSES[lens]
    large = slanted() | {"wall": wall(half=60.0)}
    expected = closed_form(large, small)
    plain = closed_form(large, replace(small, model="pinhole", distortion=()))
    found = information(large, camera=small, spp=256)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    allowed = np.maximum(0.01, 3 * found.standard_error / scale)
    assert (np.abs(found.matrix - expected) / scale < allowed).all()
    assert (np.abs(plain - expected) / scale > allowed).any()


@pytest.mark.slow
@pytest.mark.parametrize("edges", [False, True])
@pytest.mark.parametrize("lens", SMALL_LENSES)
def test_flow_through_a_lens_agrees_with_finite_differences_before_a_box(lens: str, edges: bool) -> None:
    options: Any = {**DEPTH, "depth_edges": edges, "camera": SMALL_LENSES[lens], "spp": 256}
    found = check_jacobian(scene(wall=wall(), box=BOX), **options)
    (row,) = found.rows
    allowed = np.maximum(0.01, 3 * row.ratio_standard_error) + found.reference_bias
    assert (np.abs(row.ratio - 1.0) < allowed).all(), str(found)


def test_without_the_motion_of_depth_itself_the_information_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control of the view term ż."""
    monkeypatch.setattr(view_term, "view_term", lambda *_: None)
    monkeypatch.setattr("mitsuba_crb.jacobian.flow.view_term", lambda *_: None)
    found, expected = information(slanted(), spp=256), closed_form(slanted())
    assert (np.abs(np.diag(found.matrix - expected)) > 0.1 * np.diag(expected)).any()


def test_a_plane_hides_its_own_three_motions_from_a_depth_camera() -> None:
    """Along the plane twice, and about its normal: in words."""
    bound = pose_bound(scene(wall=wall(), sensor=camera(32, 24, target=(0, 0, 3))), **{**DEPTH, "spp": 64})
    assert bound.rank == 3
    assert [direction.verdict for direction in bound.unobserved] == ["unseen"] * 3
    words = sorted(direction.description for direction in bound.unobserved)
    assert words == [
        "rotation about the optical axis (roll)",
        "translation along world axis x",
        "translation along world axis y",
    ]


@pytest.mark.parametrize("edges", [False, True])
def test_methods_agree_before_a_box(edges: bool) -> None:
    """Without edges depth is smooth, and forward mode sees it all; with them flow's contours see the rest."""
    world = scene(wall=wall(), box=BOX)
    methods = ["flow"] if edges else ["flow", "forward"]
    found = check_jacobian(world, methods=methods, spp=64, **{**DEPTH, "depth_edges": edges})
    for row in found.rows:
        allowed = np.maximum(0.01, 3 * row.ratio_standard_error) + found.reference_bias
        assert (np.abs(row.ratio - 1.0) < allowed).all(), str(found)


def test_edges_tell_more_than_the_surfaces_do() -> None:
    world = scene(wall=wall(), box=BOX)
    with_edges, without = (information(world, depth_edges=edges) for edges in (True, False))
    assert (np.diag(with_edges.matrix) > 2.0 * np.diag(without.matrix)).any()


class TestPixels:
    def counts(self, world: Any, **options: Any) -> dict[str, int]:
        bound = pose_bound(world, **{**DEPTH, "spp": 8, **options})
        return dict(bound.provenance["measures"]["pixels"])

    def test_a_plane_is_measured_everywhere_whatever_its_slant(self) -> None:
        sensor = camera(32, 24, origin=(0, 0, 0), target=(3, 0, 0.6), fov=10)
        counts = self.counts(scene(wall=wall(half=60.0), sensor=sensor))
        assert counts == {"measured": 32 * 24, "escaped": 0, "out of range": 0, "occlusion edge": 0}

    def test_corners_and_smooth_surfaces_are_no_edges(self) -> None:
        """A room's corner, and the inside of a sphere."""
        room = {"type": "cube", "to_world": T().scale([2, 2, 3]), "bsdf": GREY, "flip_normals": True}
        ball = {"type": "sphere", "center": [0, 1, 0], "radius": 5.0, "bsdf": GREY, "flip_normals": True}
        for world in (scene(room=room, sensor=camera(target=(2, 1.9, 3))), scene(ball=ball)):
            assert self.counts(world)["measured"] == 32 * 24

    def test_seams_between_the_triangles_of_a_depth_map_are_no_gaps(self) -> None:
        """A wall with a vertex wherever the lattice's rays would meet it, were those in their even places."""
        with open_view(scene(wall=wall(), sensor=camera(target=(0, 0, 3)))) as view:
            lens = view.camera
        x, y = np.meshgrid(*((np.arange(-9, 4 * n + 10) + 0.5) / 4 for n in (32, 24)))
        film = np.stack([x, y], axis=-1)
        tangent = (film - lens.centre) * lens.scale
        vertices = 3.0 * np.concatenate([tangent, np.ones((*x.shape, 1))], axis=-1)
        i = np.arange(x.size).reshape(x.shape)
        a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
        faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
        scan = mesh(vertices.reshape(-1, 3), faces, GREY)
        assert self.counts(scene(scan=scan, sensor=camera(target=(0, 0, 3))))["measured"] == 32 * 24

    @pytest.mark.parametrize("name", ["box", "gaussian"])
    def test_an_edge_takes_the_pixels_whose_filter_it_crosses(self, name: str) -> None:
        """A sheet whose edge is upright, 0.3 pixels right of the middle."""
        sensor = camera(32, 24, target=(0, 0, 3))
        sensor["film"]["rfilter"] = {"type": name}
        pixel = 2 * np.tan(np.radians(22.5)) / 32
        sheet = wall(depth=2.0, half=4.0) | {
            "to_world": T().translate([4.0 - 0.3 * 2 * pixel, 0, 2]).scale(4).rotate([0, 1, 0], 180)
        }
        world = scene(wall=wall(), sheet=sheet, sensor=sensor)
        width = {"box": 1, "gaussian": 4}[name]
        assert self.counts(world)["occlusion edge"] == width * 24
        assert self.counts(world, depth_edges=True)["occlusion edge"] == 0

    def test_what_escapes_and_what_is_out_of_range_measures_nothing(self) -> None:
        ball = {"type": "sphere", "center": [0, 0, 3], "radius": 0.5, "bsdf": GREY}
        alone = self.counts(scene(ball=ball, sensor=camera(target=(0, 0, 3))), depth_edges=True)
        assert alone["escaped"] + alone["measured"] == 32 * 24
        assert 0 < alone["measured"] < 200
        before = scene(wall=wall(), ball=ball, sensor=camera(target=(0, 0, 3)))
        near = self.counts(before, depth_range=(2.0, 2.9))
        assert 0 < near["measured"] <= alone["measured"]
        assert near["out of range"] > 400
        nothing = self.counts(before, depth_range=(5.0, 9.0))
        assert nothing["out of range"] == 32 * 24

    def test_a_view_of_nothing_has_rank_0(self) -> None:
        away = [np.diag([-1.0, 1.0, -1.0, 1.0])]
        for sigma in (SIGMA, None, Stereo(0.1, 0.2)):
            options: Any = {**DEPTH, "depth_sigma": sigma, "spp": 8}
            table = pose_table(textured_wall(), away, **options)
            assert [row.rank for row in table.rows] == [0]
            assert set(table.rows[0].verdicts) == {"unseen"}

    def test_a_gradient_rich_choice_is_of_pixels_that_measure(self) -> None:
        world = scene(wall=wall(), box=BOX)
        told = pose_jacobian(world, pixels="gradient:0.1", **{**DEPTH, "spp": 8})
        assert len(told.pixels) == 77


class TestNoise:
    def test_stereo_is_less_sure_of_what_is_far(self) -> None:
        """σ = z² σ_d/(f b) on a wall that is parallel to the film, all of the same depth."""
        facing = scene(wall=wall(), sensor=camera(24, 18, target=(0, 0, 3)))
        with open_view(facing) as view:
            focal = abs(view.camera.focal[0])
        found = information(facing, depth_sigma=Stereo(0.1, 0.2)).matrix
        sigma = 9.0 * 0.2 / (focal * 0.1)
        slope = 2.0 * sigma / 3.0
        plain = information(facing, depth_sigma=1.0).matrix
        seen = np.ix_([2, 3, 4], [2, 3, 4])
        assert misfit(found[seen], (1.0 + 2.0 * slope**2) / sigma**2 * plain[seen]) < 0.01

    def test_a_constant_table_is_a_constant(self) -> None:
        table = information(slanted(), depth_sigma=SigmaTable([1.0, 9.0], [SIGMA, SIGMA]))
        assert misfit(table.matrix, information(slanted()).matrix) < 1e-12

    def test_the_default_is_a_hundredth_of_the_depth(self) -> None:
        bound = pose_bound(slanted(), measure="depth", spp=16)
        assert bound.provenance["noise"]["model"] == SigmaPower(0.01, 1.0).to_dict()["model"]
        assert bound.provenance["noise"]["unit"] == "scene unit"

    def test_options_are_read_from_texts(self, tmp_path: Path) -> None:
        file = tmp_path / "sigma.txt"
        file.write_text("# depth sigma\n1 0.01\n3 0.05\n")
        assert parse_depth_sigma("0.02") == 0.02
        assert parse_depth_sigma("stereo:0.1,0.2") == Stereo(0.1, 0.2)
        assert parse_depth_sigma(str(file)) == SigmaTable([1, 3], [0.01, 0.05])
        assert parse_range("0.4:5") == (0.4, 5.0)
        assert parse_range("0.4:") == (0.4, float("inf"))


def test_rgbd_adds_colour_and_depth() -> None:
    """With the default noise of both, a prior included once."""
    world, options = textured_wall(), {"spp": 32, "depth_sigma": 0.02}
    prior = np.diag([0.0, 0, 0, 0, 0, 1e5])
    both = pose_bound(world, measure="rgbd", prior=prior, **options)
    colour = image_alone(pose_bound(world, spp=32))
    depth = image_alone(pose_bound(world, measure="depth", **options))
    assert misfit(both.information.matrix, (colour + depth).matrix + prior) < 1e-9
    assert both.provenance["measures"]["what"] == "rgbd"
    assert both.provenance["depth"]["noise"]["sigma"] == 0.02


class TestChannels:
    def coloured(self) -> dict[str, Any]:
        return textured_wall(sensor=camera(24, 18))

    @pytest.mark.parametrize(("channel", "index"), [("red", 0), ("green", 1), ("blue", 2)])
    def test_one_channel_tells_what_its_rows_do(self, channel: str, index: int) -> None:
        one = image_alone(pose_bound(self.coloured(), Gaussian(SIGMA), channels=channel, spp=32))
        jacobian = pose_jacobian(self.coloured(), spp=32)
        rows = jacobian.batch_values[:, :, index]
        total = rows.sum(axis=0)
        own = np.einsum("kni,knj->ij", rows, rows)
        K = len(rows)
        F = (total.T @ total - own) / (K * (K - 1)) / SIGMA**2
        assert misfit(one.matrix, F) < 1e-6

    def test_luminance_of_a_grey_scene_is_a_third_of_its_colour(self) -> None:
        values = np.repeat(np.random.default_rng(0).uniform(0.1, 0.9, (32, 32, 1)), 3, axis=2)
        paper = {"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True}
        grey = scene(wall=wall(paper), sensor=camera(24, 18))
        rgb, luminance = (
            image_alone(pose_bound(grey, Gaussian(SIGMA), channels=channels, spp=32))
            for channels in ("rgb", "luminance")
        )
        assert misfit(luminance.matrix, rgb.matrix / 3) < 1e-5

    def test_what_the_film_measures_is_overruled(self) -> None:
        sensor = camera(24, 18)
        sensor["film"]["pixel_format"] = "luminance"
        grey, colour = textured_wall(sensor=sensor), self.coloured()
        overruled = image_alone(pose_bound(grey, Gaussian(SIGMA), channels="rgb", spp=16))
        assert np.array_equal(
            overruled.matrix, image_alone(pose_bound(colour, Gaussian(SIGMA), spp=16)).matrix
        )


@pytest.mark.parametrize(
    ("options", "fault", "words"),
    [
        ({"channels": "grean"}, OptionError, "did you mean 'green'"),
        ({"measure": "deph"}, OptionError, "did you mean 'depth'"),
        ({"measure": "depth", "channels": "red"}, OptionError, "--channels"),
        ({"measure": "depth", "depth_range": (3, 3)}, OptionError, "LO < HI"),
        ({"measure": "depth", "depth_range": (np.nan, 3)}, OptionError, "LO < HI"),
        ({"measure": "depth", "depth_range": 3}, OptionError, "two depths"),
        ({"measure": "depth", "depth_sigma": 0.0}, NoiseError, "sigma of depth must be positive"),
        ({"measure": "depth", "depth_sigma": np.nan}, NoiseError, "sigma of depth must be positive"),
        ({"measure": "depth", "depth_sigma": "0.1"}, NoiseError, "noise model"),
        ({"depth_sigma": 0.1}, OptionError, "--depth-sigma"),
        ({"depth_range": (0, 1)}, OptionError, "--range"),
        ({"depth_edges": True}, OptionError, "--depth-edges"),
        ({"measure": "depth", "noise": Gaussian(0.1)}, OptionError, "--depth-sigma"),
        ({"measure": "depth", "exposure": 1.0}, OptionError, "--depth-sigma"),
        ({"measure": "rgbd", "nuisances": ["gain"]}, OptionError, "--marginalize"),
    ],
)
def test_what_does_not_go_together_is_named(options: Any, fault: type[Exception], words: str) -> None:
    with pytest.raises(fault, match=words):
        pose_bound(textured_wall(), spp=8, **options)


def test_depth_needs_a_pinhole_and_rgbd_is_of_bounds() -> None:
    with pytest.raises(SensorError, match="pinhole"):
        pose_bound(textured_wall(sensor=camera() | THIN_LENS), spp=8, measure="depth")
    with pytest.raises(OptionError, match="two measurements"):
        pose_jacobian(textured_wall(), spp=8, measure="rgbd")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,1", "neither"),
        ("stereo:0.1", "baseline"),
        ("stereo:", "baseline"),
        ("stereo:0.1,nan", "disparity"),
        ("-1", "positive"),
    ],
)
def test_a_text_that_is_no_sigma_of_depth_is_named(text: str, words: str) -> None:
    with pytest.raises((OptionError, NoiseError), match=words):
        parse_depth_sigma(text)


@pytest.mark.parametrize("text", ["3", "a:b", "1:2:3"])
def test_a_text_that_is_no_range_is_named(text: str) -> None:
    with pytest.raises(OptionError, match="LO:HI"):
        parse_range(text)


@pytest.mark.slow
@pytest.mark.parametrize("lens", [None, "barrel"])
@pytest.mark.parametrize("name", ["boxes", "textured_room"])
def test_flow_agrees_with_finite_differences_in_the_shipped_scenes(
    name: str, lens: str | None, scenes: Path
) -> None:
    own: Any = {"size": (64, 48)} if lens is None else {"camera": LENSES[lens]}
    found = check_jacobian(scenes / name / f"{name}.xml", spp=512, **own, **DEPTH)
    (row,) = found.rows
    assert (np.abs(row.ratio - 1.0) < np.maximum(0.01, 3 * row.ratio_standard_error)).all(), str(found)


def test_many_poses_say_stereo_in_words(scenes: Path, tmp_path: Path, capsys: Any) -> None:
    np.save(tmp_path / "poses.npy", np.array([se3.exp([0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.0]) for k in range(2)]))
    words = ["--poses", str(tmp_path / "poses.npy"), "--measure", "depth", "--depth-sigma", "stereo:0.1,0.2"]
    scene = str(scenes / "textured_wall" / "textured_wall.xml")
    assert cli.run(["bound", scene, "--size", "12x8", "--spp", "8", *words]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "of depth [scene unit]: stereo, baseline 0.1, disparity ± 0.2 pixels" in out


class TestCommand:
    def run(self, scenes: Path, *words: str) -> int:
        scene = str(scenes / "boxes" / "boxes.xml")
        return cli.run(["bound", scene, "--size", "24x18", "--spp", "16", *words])

    def test_table_and_document_name_what_is_measured(
        self, scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        file = tmp_path / "bound.json"
        words = ["--measure", "depth", "--depth-sigma", "stereo:0.1,0.2", "--range", "1:30"]
        assert self.run(scenes, *words, "--json", str(file)) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert "depth along the optical axis [scene unit]" in text
        assert "stereo, baseline 0.1" in text
        document = json.loads(file.read_text(encoding="utf-8"))
        assert document["measures"]["unit"] == document["noise"]["unit"] == "scene unit"
        counts = document["measures"]["pixels"]
        assert sum(counts.values()) == 24 * 18
        assert counts["occlusion edge"] > 0

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            ("--channels blu", "did you mean 'blue'"),
            ("--measure rgb", "did you mean 'rgbd'"),
            ("--measure depth --range 5:1", "LO < HI"),
            ("--measure depth --depth-sigma 0", "positive"),
            ("--measure depth --depth-sigma nan", "positive"),
            ("--measure depth --depth-sigma stereo:", "stereo:0.05,0.1"),
            ("--measure depth --depth-sigma table.txt", "row 3 does not"),
            ("--depth-sigma 0.1", "--measure depth"),
            ("--measure depth --channels red", "leave it out"),
            ("--measure depth --sigma 0.1", "--depth-sigma"),
            ("--measure depth --hcr", "--hcr"),
        ],
    )
    def test_bad_input_is_named_in_one_line(
        self,
        words: str,
        said: str,
        scenes: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.chdir(tmp_path)
        Path("table.txt").write_text("1 0.1\n2 0.1\n2 0.2\n")
        assert self.run(scenes, *words.split()) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
