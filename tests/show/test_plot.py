from __future__ import annotations

import dataclasses
import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest
import synthetic_view
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from mitsuba_crb.measure.pictures import pictures_of
from mitsuba_crb.noise import Gaussian
from mitsuba_crb.show import align_page, plot, poses_page, team_page, trials_page
from mitsuba_crb.show import bound_page as page

TURN = Rotation.from_euler("xyz", [20, 30, 10], degrees=True).as_matrix()


def axes():
    return Figure().add_subplot()


def words(figure) -> str:
    """Every text on a figure."""
    return "\n".join(text.get_text() for text in figure.findobj(mpl.text.Text))


def page_of(**options):
    view = synthetic_view.jacobian(**options)
    bound = synthetic_view.bound(view)
    return bound, page.bound_figure(bound, pictures_of(view, bound.information))


def test_render_maps_white_to_white_and_the_unmeasured_to_grey():
    image = np.full((4, 4, 3), 0.5)
    image[0, 0] = np.nan
    shown = np.asarray(plot.draw_render(axes(), image).get_array())
    np.testing.assert_allclose(shown[1:], 1.0)
    assert 0 < shown[0, 0, 0] < 1


def test_render_is_srgb():
    image = np.ones((10, 10, 3))
    image[0, 0] = 0.2140411  # linear value of sRGB 0.5
    shown = np.asarray(plot.draw_render(axes(), image).get_array())
    np.testing.assert_allclose(shown[0, 0], 0.5, atol=1e-5)


def test_a_displayed_image_is_shown_as_it_is():
    image = np.array([[[0.5, 0.25, 0.75], [1.5, -0.1, 0.1]]])
    shown = np.asarray(plot.draw_render(axes(), image, displayed=True).get_array())
    np.testing.assert_array_equal(shown, np.clip(image, 0.0, 1.0))


def test_the_page_names_the_unit_of_what_is_measured():
    for measures, unit in (({}, "radiance"), ({"unit": "display-referred"}, "display-referred")):
        view = synthetic_view.jacobian()
        bound = synthetic_view.bound(view)
        bound = dataclasses.replace(bound, provenance={**bound.provenance, "measures": measures})
        drawn = page.bound_figure(bound, pictures_of(view, bound.information))
        labels = [ax.get_ylabel() for ax in drawn.axes]
        assert sum(label.endswith((f"{unit} / rad", f"{unit} / scene unit")) for label in labels) == 2


@pytest.mark.parametrize("image", [np.zeros((3, 4, 3)), np.full((3, 4, 3), np.nan)])
def test_black_and_unmeasured_images_can_be_drawn(image):
    plot.draw_render(axes(), image)
    plot.draw_column(axes(), image)
    plot.draw_information(axes(), image[..., 0])


def test_column_is_white_at_zero_with_symmetric_limits():
    drawn = plot.draw_column(axes(), np.array([[[-3.0] * 3, [1.0] * 3, [0.0] * 3]]))
    low, high = drawn.get_clim()
    assert low == -high < 0
    np.testing.assert_allclose(drawn.to_rgba(0.0)[:3], 1.0, atol=0.05)
    red, _, blue, _ = drawn.to_rgba(high)
    assert red > blue


def test_information_map_sums_blocks_and_tells_nothing_found_from_not_measured():
    information = np.random.default_rng(0).random((20, 40))
    information[:16, 32:] = -1.0
    information[16:, :16] = np.nan
    information[0, 0] = np.nan
    drawn = plot.draw_information(axes(), information, block=16)
    shown = np.asarray(drawn.get_array().filled(np.nan))
    assert shown.shape == (2, 3)
    assert shown[0, 0] == pytest.approx(np.nansum(information[:16, :16]))
    assert shown[1, 2] == pytest.approx(information[16:, 32:].sum())
    np.testing.assert_array_equal(np.isnan(shown), [[False] * 3, [True, False, False]])
    colours = drawn.to_rgba(drawn.get_array())
    assert colours[1, 0, 3] == 0.0  # lets the axes' grey through
    np.testing.assert_array_equal(colours[0, 2], mpl.colormaps["magma"](0.0))


@pytest.mark.parametrize("width", [1, 40, 63, 64, 65, 127, 128, 160, 512, 1000])
def test_information_map_is_64_cells_wide_or_as_wide_as_the_image(width):
    ax = axes()
    drawn = plot.draw_information(ax, np.ones((30, width)))
    cells = drawn.get_array().shape[1]
    assert cells == width if width < 64 else 64 <= cells < 128
    assert ax.get_xlim() == (-0.5, width - 0.5)
    assert ax.get_ylim() == (29.5, -0.5)


def test_pixels_finer_than_the_dots_are_averaged_and_coarser_ones_are_squares():
    figure = Figure(figsize=(2, 2), dpi=100)
    FigureCanvasAgg(figure)
    for size, low, high in ((1000, 0.45, 0.55), (40, 0.0, 1.0)):
        figure.clear()
        stripes = np.tile([0.0, 1.0], (size, size // 2))
        plot.draw_picture(figure.add_axes((0, 0, 1, 1)), stripes, cmap="gray")
        figure.canvas.draw()
        inside = np.asarray(figure.canvas.buffer_rgba())[50:150, 50:150, 0] / 255
        assert low <= inside.min()
        assert inside.max() <= high
        assert (inside.min(), inside.max()) == (0.0, 1.0) or size > 200


@pytest.mark.parametrize("plane", [(0, 1), (0, 2), (1, 2)])
def test_ellipse_is_the_shadow_of_the_ellipsoid(plane):
    lengths = np.array([3.0, 2.0, 0.5])
    drawn = plot.draw_ellipse(axes(), lengths, TURN, plane, reach=4.0)
    outline = drawn[1].get_xy()
    covariance = (TURN * lengths**2 @ TURN.T)[np.ix_(plane, plane)]
    level = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance), outline)
    np.testing.assert_allclose(level, 1.0, rtol=1e-9)
    # the shadow of a 1σ ellipsoid is as wide as the marginal standard deviation
    np.testing.assert_allclose(outline.max(axis=0), np.sqrt(np.diag(covariance)), rtol=1e-3)


def test_unseen_axis_becomes_a_band_along_it_as_wide_as_the_rest():
    ax = axes()
    plot.draw_ellipse(ax, np.array([np.inf, 2.0, 0.5]), np.eye(3), (0, 1), reach=4.0)
    band = ax.patches[0].get_xy()
    assert set(np.round(np.abs(band[:, 1]), 9)) == {2.0}
    assert np.abs(band[:, 0]).min() > 4.0
    assert "unseen" in words(ax)


def test_unseen_axis_across_the_plane_leaves_its_picture_finite():
    ax = axes()
    plot.draw_ellipse(ax, np.array([np.inf, 2.0, 0.5]), np.eye(3), (1, 2), reach=4.0)
    assert np.abs(ax.patches[0].get_xy()).max() == pytest.approx(2.0)
    assert "unseen" not in words(ax)


def test_axis_that_is_not_resolved_is_dashed_and_says_so():
    styles = {}
    for unresolved in (False, True):
        ax = axes()
        plot.draw_ellipse(
            ax, np.array([np.inf, 2.0, 0.5]), np.eye(3), (0, 1), reach=4.0, unresolved=unresolved
        )
        styles[unresolved] = ax.patches[1].get_linestyle(), ax.patches[0].get_hatch(), words(ax).strip()
    assert styles[True][:2] == ("--", None)
    assert styles[False][:2] == ("-", "////")
    assert "not resolved" in styles[True][2]
    assert "not resolved" not in styles[False][2]


def test_plane_that_is_unseen_everywhere_is_filled_and_says_so():
    ax = axes()
    plot.draw_ellipse(ax, np.array([np.inf, np.inf, 0.5]), np.eye(3), (0, 1), reach=4.0)
    assert np.abs(ax.patches[0].get_xy()).min() > 4.0
    assert "unseen" in words(ax)


def test_ellipsoid_panels_share_one_scale_and_follow_sigma():
    bound = synthetic_view.bound(synthetic_view.jacobian())
    extents = []
    for sigma in (1.0, 2.0):
        panels = [axes() for _ in range(3)]
        plot.draw_ellipsoid(panels, bound, "position", sigma=sigma)
        assert len({ax.get_xlim() for ax in panels} | {ax.get_ylim() for ax in panels}) == 1
        assert all(ax.get_aspect() == 1.0 for ax in panels)
        unit = float(f"1e{panels[0].get_xlabel().split('{')[1].split('}')[0]}")
        extents.append(unit * panels[0].patches[0].get_xy()[:, 0].max())
    assert extents[0] == pytest.approx(bound.position_std[0], rel=1e-3)
    assert extents[1] == pytest.approx(2 * extents[0], rel=1e-6)


def test_page_names_what_it_shows():
    _, figure = page_of()
    text = words(figure)
    for word in ("relief", "Render", "Fisher information", "1σ", "world axes", "camera axes", "rank 6 of 6"):
        assert word in text
    for symbol in (r"\rho", r"\varphi"):
        for axis in "xyz":
            assert rf"\partial {symbol}_{axis}" in text
    assert "radiance / scene unit" in text
    assert "radiance / rad" in text
    assert "unseen" not in text
    assert len(figure.findobj(mpl.image.AxesImage)) >= 8


def test_page_says_unseen_where_the_bound_is_infinite():
    bound, figure = page_of(unseen=(1, 5), noise=0.05)
    assert bound.rank == 4
    assert words(figure).count("unseen") >= 6


def test_page_of_an_image_without_information_shows_none_of_it():
    bound, figure = page_of(unseen=(0, 1, 2, 3, 4, 5))
    assert bound.rank == 0
    assert "none" in words(figure)


@pytest.mark.parametrize("kind", ["random", "only"])
def test_page_of_a_subset_names_it_and_is_grey_only_where_nothing_stands_for_a_pixel(kind):
    _, figure = page_of(kind=kind, fraction=0.2)
    assert f"{kind}:x of them" in words(figure)
    assert ("not measured" in words(figure)) == (kind == "only")
    maps = [drawn.get_array() for drawn in figure.findobj(mpl.image.AxesImage)]
    unmeasured = [np.mean(np.ma.getmaskarray(values)) for values in maps if values.ndim == 2]
    assert len(unmeasured) >= 8
    np.testing.assert_allclose(unmeasured, 0.0 if kind == "random" else 0.8, atol=0.03)


def test_maps_of_a_random_subset_add_up_to_the_whole_image():
    """Each pixel stands for those nearest to it, as many as N/n on average: to their number's spread."""
    view = synthetic_view.jacobian(kind="random", fraction=0.3, noise=0.01)
    bound = synthetic_view.bound(view)
    noise = Gaussian(synthetic_view.SIGMA)
    figure = page.bound_figure(bound, pictures_of(view, bound.information, noise))
    every = synthetic_view.jacobian(noise=0.01)
    whole = pictures_of(every, synthetic_view.bound(every).information, noise)
    shown, share = (
        next(ax for ax in figure.axes if ax.get_title("left") == name).images[0].get_array()
        for name in ("Fisher information", "Weakest direction")
    )
    assert shown.sum() == pytest.approx(np.nansum(whole.information), rel=0.1)
    assert share.sum() == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize(
    "options",
    [{}, {"height": 96, "width": 64}, {"height": 20, "width": 90}, {"unseen": (1, 5), "noise": 0.05}],
    ids=["landscape", "portrait", "panorama", "unseen"],
)
def test_nothing_written_on_the_page_touches_other_words_or_another_panel(options):
    _, figure = page_of(**options)
    figure.canvas.draw()
    written = [(figure, text) for text in figure.texts]
    for ax in figure.axes:
        written += [(ax, text) for text in (*ax.texts, ax.title, ax._left_title, ax._right_title)]
        for axis in (ax.xaxis, ax.yaxis):
            low, high = sorted(axis.get_view_interval())
            ticks = [
                t for t in (*axis.get_major_ticks(), *axis.get_minor_ticks()) if low <= t.get_loc() <= high
            ]
            written += [(ax, label) for t in ticks for label in (t.label1, t.label2) if label.get_visible()]
            written.append((ax, axis.label))
    boxes = [
        (ax, text.get_text(), text.get_window_extent()) for ax, text in written if text.get_text().strip()
    ]
    assert len(boxes) > 40
    page_box = figure.bbox
    for k, (ax, name, box) in enumerate(boxes):
        assert page_box.x0 <= box.x0 <= box.x1 <= page_box.x1, name
        assert page_box.y0 <= box.y0 <= box.y1 <= page_box.y1, name
        for _, other, its in boxes[k + 1 :]:
            assert not box.overlaps(its), (name, other)
        for panel in figure.axes:
            assert panel is ax or not box.overlaps(panel.get_window_extent()), name


@pytest.mark.slow
def test_plotting_touches_no_global_state(tmp_path):
    before = dict(mpl.rcParams)
    view = synthetic_view.jacobian()
    bound = synthetic_view.bound(view)
    path = tmp_path / "page.png"
    page.write_plot(path, bound, pictures_of(view, bound.information))
    assert dict(mpl.rcParams) == before
    height, width, _ = imread(path).shape
    assert width > 1500
    assert height > 900


@pytest.mark.slow
def test_pyplot_is_never_imported():
    code = "import sys, mitsuba_crb.show.bound_page; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_tiles_that_are_sent_are_numbered_and_the_others_dimmed():
    tiles = np.array([[0, 0, 4, 3], [4, 0, 4, 3], [0, 3, 4, 3], [4, 3, 4, 3]])
    ax = axes()
    plot.draw_tiles(ax, np.full((6, 8, 3), 0.5), tiles, [(2, 1), (1, 7)])
    assert {text.get_text(): text.get_position() for text in ax.texts} == {"1": (1.5, 4.0), "7": (5.5, 1.0)}
    dimmed = [patch.get_xy() for patch in ax.patches if patch.get_fill()]
    assert dimmed == [(-0.5, -0.5), (3.5, 2.5)]


def test_a_budget_curve_leaves_out_what_does_not_exist_and_shades_what_is_out_of_reach():
    ax = axes()
    values = {"chosen": [1.0, 2.0, 3.0], "random": [-np.inf, 0.5, 1.0]}
    plot.draw_budget_curve(ax, [2, 4, 8], values, bound=[2.0, 3.0, 3.5])
    lines = {line.get_label(): line.get_ydata() for line in ax.lines}
    np.testing.assert_array_equal(lines["chosen"], values["chosen"])
    np.testing.assert_array_equal(lines["random"], [np.nan, 0.5, 1.0])
    low, high = ax.get_ylim()
    assert low < 0.5
    assert high > 3.5
    (shade,) = ax.collections
    vertices = shade.get_paths()[0].vertices
    assert vertices[:, 1].min() == 2.0
    assert vertices[:, 1].max() == high
    assert {text.get_text() for text in ax.get_legend().get_texts()} == {"chosen", "random", "out of reach"}


def luminance(colours):
    """Of sRGB colours (n, 3): relative luminance, (n,)."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def by_deuteranopes(colours):
    """sRGB colours (n, 3) as those see them who lack the middle cones; Viénot, Brettel and Mollon 1999."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    red_green = linear @ [0.29275, 0.70725, 0.0]
    blue = linear @ [-0.02234, 0.02234, 1.0]
    return np.clip(np.stack([red_green, red_green, blue], axis=1), 0.0, 1.0)


@pytest.mark.parametrize("name", [plot.SEQUENTIAL, poses_page.COLOURS])
def test_a_sequential_map_survives_greyscale(name):
    steps = np.diff(luminance(mpl.colormaps[name](np.linspace(0, 1, 64))[:, :3]))
    assert np.all(steps > 0) or np.all(steps < 0)


def test_the_diverging_map_darkens_to_both_sides_and_they_differ_to_the_colour_blind():
    colours = mpl.colormaps[plot.DIVERGING](np.linspace(0, 1, 65))[:, :3]
    steps = np.diff(luminance(colours))
    assert np.all(steps[:32] > 0)
    assert np.all(steps[32:] < 0)
    below, above = by_deuteranopes(colours[8:25]), by_deuteranopes(colours[56:39:-1])
    assert np.all(np.abs(below - above).max(axis=1) > 0.1)


IMAGE = np.random.default_rng(0).random((6, 8, 3))
DRAWN = {
    plot.draw_render: (IMAGE,),
    plot.draw_column: (IMAGE - 0.5,),
    plot.draw_information: (IMAGE[..., 0],),
    plot.draw_picture: (IMAGE,),
    plot.draw_ellipse: (np.ones(3), np.eye(3), (0, 1)),
    plot.draw_tiles: (IMAGE, np.array([[0, 0, 8, 3], [0, 3, 8, 3]]), [(0, 1)]),
    plot.draw_budget_curve: ([1, 2], {"chosen": [1.0, 2.0]}),
    trials_page.draw_calibration: (np.arange(1.0, 9.0),),
    trials_page.draw_squares: (np.arange(1.0, 9.0),),
    trials_page.draw_ratios: (np.ones(6), np.tile([0.5, 1.5], (6, 1))),
}
NAMED = {plot.draw_ellipse: {"reach": 2.0}, plot.draw_budget_curve: {"bound": [2.0, 3.0]}}
ELSEWHERE = {plot.draw_ellipsoid, poses_page.draw_path, poses_page.draw_along}


def test_every_public_plot_draws_where_it_is_told_and_returns_what_it_drew():
    public = {
        value
        for module in (plot, trials_page, poses_page, page, team_page, align_page)
        for name, value in vars(module).items()
        if name.startswith("draw_") and value.__module__ == module.__name__
    }
    assert public == {*DRAWN, *ELSEWHERE}
    for draw, arguments in DRAWN.items():
        figure = Figure()
        other, ax = figure.subplots(1, 2)
        before = len(other.get_children())
        drawn = draw(ax, *arguments, **NAMED.get(draw, {}))
        drawn = drawn if isinstance(drawn, list) else [drawn]
        assert drawn, draw
        for artist in drawn:
            assert isinstance(artist, mpl.artist.Artist)
            assert artist.axes is ax
        assert len(other.get_children()) == before
        assert len(figure.axes) == 2


def test_the_ellipsoid_returns_what_it_drew_in_each_of_its_axes():
    panels = Figure().subplots(1, 3)
    drawn = plot.draw_ellipsoid(panels, synthetic_view.bound(synthetic_view.jacobian()), "rotation")
    assert {artist.axes for artist in drawn} == set(panels)


def test_rules_are_told_apart_without_colour():
    ax = axes()
    values = {name: [1.0, 2.0] for name in "abcde"}
    plot.draw_budget_curve(ax, [1, 9], values, bound=[2.0, 3.0])
    assert len({(line.get_marker(), line.get_linestyle()) for line in ax.lines}) == 5
    assert len({line.get_linestyle() for line in ax.lines}) >= 4
    ticks = ax.get_xticks()
    np.testing.assert_array_equal(ticks, np.round(ticks))
