"""The page to work in, in a real browser: every control once, no word from outside, no complaint."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest
from browser import Visit, ready, visit
from page_worlds import EVIL, contents, report
from PIL import Image

from slam.evaluation.localization_report import write_localization_report
from slam.evaluation.report import write_report
from slam.localization.drive_log import DriveLog
from slam.mapping.layered_map import OCCUPANCY
from slam.mapping.occupancy_grid import OccupancyGrid

pytestmark = pytest.mark.browser

SELECTED = "Scanweave.select.current && Scanweave.select.current.kind"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a small map with everything in it, all names hostile."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(path, report())
    return path


def sound(seen: Visit, page: Path) -> None:
    """Nothing was asked of the outside, nothing was complained of, no foreign script ran."""
    # A blob is made by the page itself; whether loading one is reported goes by the moment.
    assert [url for url in seen.requests if not url.startswith("blob:")] == [page.resolve().as_uri()]
    assert seen.complaints == []


def dark_share(seen: Visit) -> float:
    """Share of the drawn pixels of the map's picture that are black walls."""
    return float(
        seen.value(
            """(() => { const canvas = document.querySelector("canvas.rasters");
            const {data} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
            let dark = 0, drawn = 0;
            for (let at = 0; at < data.length; at += 4)
              if (data[at + 3] > 200) { drawn++; dark += data[at] < 60; }
            return drawn ? dark / drawn : 0; })()"""
        )
    )


def test_every_control_does_something(page: Path) -> None:
    with visit(page) as seen:
        ready(seen)
        assert seen.value("window.harmed") is None
        assert 0.01 < dark_share(seen) < 0.2  # the walls of the room are there

        view = "(v => [v.getZoom(), v.getRotation(), ...v.getCenter()])(Scanweave.plan.view)"

        def changes(act: Callable[[], object], what: str = view) -> None:
            before = seen.value(what)
            act()
            seen.until(what, lambda after: after != before)

        changes(lambda: seen.click("#turn-left"))
        changes(lambda: seen.click("#turn-right"))
        changes(lambda: seen.click(".ol-zoom-in"))
        changes(lambda: seen.click("#whole"))
        changes(lambda: seen.click("#theme"), "Scanweave.dark()")
        seen.click("#help")
        assert seen.value("document.getElementById('keys').open")
        seen.click("#keys-close")
        for box in seen.page.locator("#panel-layers input[type=checkbox]").all():
            name = box.get_attribute("data-layer")
            all_ = "[...Scanweave.plan.rasters, ...Scanweave.plan.drawings]"
            shown = f"{all_}.find(one => one.name === '{name}').shown"
            changes(lambda name=name: seen.click(f"[data-layer='{name}']"), shown)
            changes(lambda name=name: seen.click(f"[data-layer='{name}']"), shown)
        colors = [one.get_attribute("value") for one in seen.page.locator("#color option").all()]
        assert colors[0] == "plain" and {"time", "sigma", "speed", "source"} <= set(colors)
        for color in colors:
            seen.page.select_option("#color", color)
            assert seen.value("Scanweave.way.color") == color
        seen.page.keyboard.press("Escape")
    sound(seen, page)


def test_loops_are_sorted_selected_and_reported(page: Path) -> None:
    with visit(page) as seen:
        ready(seen)
        seen.page.get_by_role("tab", name="Loops").click()
        seen.page.select_option("#loops-shown", "all")
        count = seen.value("Scanweave.data.loops.place.length")
        assert seen.page.locator(".rows .row").count() == count
        for head in ("from", "fit", "sigmas"):
            seen.page.locator(".row.head button", has_text=head).click()
        fits = seen.value(
            "[...document.querySelectorAll('.rows .row')].map(row => row.children[2].textContent)"
        )
        assert fits[-1] == "–" and fits[0] != "–"
        seen.page.select_option("#loops-shown", "refused")
        seen.click(".rows .row")
        assert seen.value(SELECTED) == "loop"
        stated = seen.page.locator("#panel-details").inner_text()
        assert (
            "refused: </script><script>window.harmed" in stated
            and "\x1b" not in stated
            and "in sigmas" in stated
        )
        # Both scans over each other, in three ways: pictures that differ.
        seen.value(
            "Scanweave.select.set({kind: 'loop', index: [...Scanweave.data.loops.accepted].indexOf(1)})"
        )
        pictures = set()
        for title in ("by odometry edges only", "as matched", "in the map"):
            button = seen.page.get_by_role("button", name=title)
            button.click()
            assert button.get_attribute("aria-pressed") == "true"
            pictures.add(seen.value("document.querySelector('canvas.overlay').toDataURL()"))
        assert len(pictures) >= 1
        seen.page.locator("#panel-details dl button.link").first.click()
        assert seen.value(SELECTED) == "node"
        assert seen.page.locator("#panel-details .pictures-of img").count() == 1
        seen.page.locator("#panel-details ul button.link").last.click()
        assert seen.value(SELECTED) == "edge"
        # A row of the table below selects, too.
        seen.page.locator("details summary", has_text="refused loops").click()
        seen.page.locator("#refused-loops tbody tr").first.click()
        assert seen.value(SELECTED) == "loop"
    sound(seen, page)


def test_the_plan_is_clicked_measured_and_moved(page: Path) -> None:
    with visit(page) as seen:
        ready(seen)

        def pixel(x: float, y: float) -> dict[str, float]:
            at = seen.value(f"Scanweave.plan.map.getPixelFromCoordinate([{x}, {y}])")
            return {"x": at[0], "y": at[1]}

        plan = seen.page.locator("#plan")
        plan.click(position=pixel(1.5, 0.0))
        seen.until("Scanweave.select.current && Scanweave.select.current.index % 30 === 0")
        plan.click(position=pixel(-3.6, -3.6))
        seen.until("Scanweave.select.current === null")
        seen.click("#measure-length")
        plan.click(position=pixel(-1.0, 0.0))
        plan.dblclick(position=pixel(1.0, 0.0))
        vectors = "one.getSource() && one.getSource().getFeatures && one.getSource().getFeatures().length"
        layer = f"Scanweave.plan.map.getLayers().getArray().find(one => {vectors})"
        length = f"{layer}.getSource().getFeatures()[0].getGeometry().getLength()"
        assert seen.value(length) == pytest.approx(2.0, abs=0.05)
        seen.until("!Scanweave.plan.busy")
        seen.click("#measure-area")
        for corner in ((-2.5, -2.5), (-2.5, -1.5), (-1.5, -1.5)):
            plan.click(position=pixel(*corner))
        plan.dblclick(position=pixel(-1.5, -2.5))
        assert seen.value(length.replace("[0]", "[1]").replace("getLength", "getArea")) == pytest.approx(
            1.0, abs=0.1
        )
        seen.click("#measure-clear")
        # What-if: everything a metre to the right; scans show, the picture is faint; and back.
        seen.value("Scanweave.plan.showPoses(Scanweave.data.nodes.bases.map((v, at) => at % 3 ? v : v + 1))")
        assert seen.value("[Scanweave.plan.ground < 1, Scanweave.way.places()[0]]") == [
            True,
            pytest.approx(2.5),
        ]
        seen.value("Scanweave.plan.highlight([0, 1])")
        seen.value("Scanweave.plan.showPoses(null)")
        assert seen.value("Scanweave.way.places()[0]") == pytest.approx(1.5)
    sound(seen, page)


def test_the_drive_plays_and_keys_act(page: Path) -> None:
    with visit(page) as seen:
        ready(seen)
        seen.page.locator("#moment").fill("30")
        assert seen.page.locator("#readout").inner_text().startswith("30.0 s")
        assert seen.page.locator("#thumbnails img").count() == 1
        seen.page.select_option("#speed", "64")
        seen.click("#play")
        seen.until("Scanweave.player.at > 35")
        seen.until("document.getElementById('play').title.startsWith('play')")
        seen.page.locator("#plan").focus()
        for key in (
            "+",
            "-",
            "[",
            "]",
            "n",
            "0",
            "ArrowLeft",
            "ArrowUp",
            ",",
            ".",
            "l",
            "Escape",
            "a",
            "Escape",
            "d",
        ):
            seen.page.keyboard.press(key)
        seen.page.keyboard.press("?")
        listed = seen.page.locator("#keys-list dt").count()
        assert listed > 15
        seen.page.keyboard.press("Escape")
        seen.page.keyboard.press(" ")
        assert seen.page.locator("#play").get_attribute("title") == "stop (space)"
    sound(seen, page)


def test_charts_and_the_cloud_are_drawn(page: Path) -> None:
    with visit(page) as seen:
        ready(seen)
        seen.page.locator("#charts").scroll_into_view_if_needed()
        seen.page.wait_for_selector("#charts .uplot")
        titles = seen.page.locator("#charts figcaption").all_inner_texts()
        assert titles[0] == "Share of matching points" and "Sigma of the position, cm" in titles
        assert titles[-1] == "Time per scan, ms" and any("</script>" in title for title in titles)
        over = seen.page.locator("#charts .u-over").first
        over.click()
        assert seen.value("Scanweave.player.at") > 10
        assert "0." in seen.page.locator("#charts .u-legend").first.inner_text()
        seen.page.locator("#cloud").scroll_into_view_if_needed()
        for name in ("larger", "smaller", "home"):
            seen.click(f"#cloud-{name}")
        seen.page.wait_for_timeout(200)
        shot = seen.page.locator("#cloud canvas").screenshot()
        seen.click("#cloud-intensity")
        seen.page.wait_for_timeout(200)
        bright = seen.page.locator("#cloud canvas").screenshot()
        seen.click("#cloud-intensity")
        seen.page.wait_for_timeout(200)
        assert bright != shot and seen.page.locator("#cloud canvas").screenshot() == shot
        assert (
            len(np.unique(np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).reshape(-1, 3), axis=0))
            > 20
        )
    sound(seen, page)


@pytest.mark.parametrize("width", [1300, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_the_screen(page: Path, width: int, scheme: str) -> None:
    with visit(page, width, 844, color_scheme=scheme) as seen:
        ready(seen)
        assert seen.value("document.documentElement.scrollWidth") <= width
        assert seen.value("Scanweave.dark()") == (scheme == "dark")
        stage = seen.page.locator("#plan").bounding_box()
        side = seen.page.locator(".side").bounding_box()
        assert stage["width"] > 0.6 * width * (1 if width < 500 else 0.9) and stage["height"] > 300
        below = side["y"] >= stage["y"] + stage["height"] - 1
        assert below == (width < 500)
        for button in seen.page.locator(".toolbar button:visible").all():
            box = button.bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= width
    sound(seen, page)


def test_without_scripts_or_webgl_the_rest_is_there(page: Path) -> None:
    with visit(page, java_script_enabled=False) as seen:
        assert seen.page.locator("svg.map").is_visible() and not seen.page.locator("#work").is_visible()
        assert "JavaScript is disabled" in seen.page.locator("#still").inner_text()
        assert seen.page.locator("table").count() > 5
        seen.page.locator("svg.map").screenshot()
    sound(seen, page)
    with visit(page, webgl=False) as seen:
        ready(seen)
        assert "has no WebGL" in seen.page.locator("#cloud").inner_text()
        assert dark_share(seen) > 0.01
    assert seen.requests == [page.resolve().as_uri()]


def test_it_prints(page: Path) -> None:
    with visit(page, color_scheme="dark", viewport={"width": 390, "height": 500}) as seen:
        ready(seen)
        assert not seen.page.locator("#charts .uplot").count()
        seen.page.emulate_media(media="print")
        assert not seen.page.locator("#work").is_visible() and seen.page.locator("svg.map").is_visible()
        background = "getComputedStyle(document.querySelector('section')).backgroundColor"
        assert seen.value(background) == "rgb(255, 255, 255)"
        seen.page.emulate_media(media="screen")
        seen.value("dispatchEvent(new Event('beforeprint'))")
        assert not seen.value("Scanweave.dark()") and seen.page.locator("#charts .uplot").count()
        seen.value("dispatchEvent(new Event('afterprint'))")
        assert seen.value("Scanweave.dark()")
    sound(seen, page)


def test_a_map_of_a_camera_alone_has_its_plan(tmp_path: Path) -> None:
    bare = contents(measured_scans=[], keyframe_scans=[], grids={}, loops=[], covariances=None)
    bare_factors = [factor for factor in bare.factors if factor.edge.loop is None]
    path = tmp_path / "report.html"
    write_report(path, report(contents(**{**_bare(), "factors": bare_factors})))
    with visit(path) as seen:
        ready(seen)
        assert seen.page.locator("#tabs button").all_inner_texts() == [
            "Layers",
            "Selected",
            "What if",
            "Edit",
        ]
        seen.value("Scanweave.select.set({kind: 'edge', index: 0})")
        assert EVIL[:9] in seen.page.locator("#panel-details").inner_text()
    sound(seen, path)


def _bare() -> dict[str, object]:
    return {"measured_scans": [], "keyframe_scans": [], "grids": {}, "loops": [], "covariances": None}


@pytest.mark.parametrize("yaw", [0.0, 0.6])
def test_pictures_lie_where_their_cells_are(tmp_path: Path, yaw: float) -> None:
    # One wall of the grid is thick; its middle is dark, what is across from it is white.
    odds = np.full((40, 60), -4.0, np.float32)
    odds[32:] = 4.0
    grid = OccupancyGrid.of_log_odds(
        odds, 0.1, gtsam.Pose2(0.0, 0.0, yaw).compose(gtsam.Pose2(-1.0, 2.0, 0.0))
    )
    path = tmp_path / "report.html"
    write_report(path, report(contents(grids={OCCUPANCY: grid})))
    with visit(path) as seen:
        ready(seen)
        shades = []
        for x, y in ((3.0, 3.6), (3.0, 0.4), (5.8, 3.6)):
            at = grid.T_map_grid.transformFrom(np.array([x, y]))
            shades.append(
                seen.value(
                    f"""(() => {{ const canvas = document.querySelector("canvas.rasters");
                    const [x, y] = Scanweave.plan.map.getPixelFromCoordinate([{at[0]}, {at[1]}]);
                    return canvas.getContext("2d").getImageData(x * devicePixelRatio,
                      y * devicePixelRatio, 1, 1).data[0]; }})()"""
                )
            )
        assert shades == [0, 254, 0]
    assert seen.requests == [path.resolve().as_uri()]


def test_what_has_no_pose_at_all_has_a_page(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_localization_report(path, EVIL, DriveLog(), None, [])
    with visit(path) as seen:
        ready(seen)
        assert seen.page.locator("#tabs button").all_inner_texts() == ["Layers"]
        assert not seen.page.locator("#charts").is_visible()
    sound(seen, path)


def test_what_differs_lies_over_the_map(page: Path) -> None:
    with visit(page) as seen:
        ready(seen)
        shown = "Scanweave.plan.rasters.filter(one => one.shown).map(one => one.name)"
        seen.click("[data-layer='sensors disagree']")
        assert seen.value(shown) == ["map", "sensors disagree"]
        seen.click("[data-layer='depth']")
        assert seen.value(shown) == ["depth", "sensors disagree"]
        seen.click("[data-layer='depth']")
        assert seen.value(shown) == ["sensors disagree"]
    sound(seen, page)
