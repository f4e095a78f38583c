"""The page of a run in a browser: what is clicked, dragged and typed does what it says.

It needs Chromium and the package playwright, which is in the ``dev`` extra; without them these
tests are skipped, and ``test_report.py`` alone checks what a page holds.
"""

import base64
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.report import write_report
from neuroslam.runs.files import RowWriter, RunPlan
from neuroslam.runs.plan import plan
from neuroslam.runs.reading import read_frames
from neuroslam.runs.results import RunSaver, RunSummary, write_results
from neuroslam.runs.run import run
from neuroslam.runs.saves import writing
from neuroslam.types import Frame, Motion, PoseEstimate, StepResult, ViewMatch

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

WORLD = "world:ellipse?laps=2&width=96&height=24&frames_per_lap=90"
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        own = Path(playwright.chromium.executable_path)
        found = own if own.is_file() else next(filter(None, map(shutil.which, NAMES)), None)
        if found is None:
            pytest.skip("no Chromium found: install the system's, or `playwright install chromium`")
        browser = playwright.chromium.launch(executable_path=found)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A session, and a second one that joined its map."""
    folder = tmp_path_factory.mktemp("runs")
    run(WORLD, folder / "first", stop=100, tensorboard=False)
    run(WORLD, folder / "second", maps=[folder / "first"], start=40, tensorboard=False)
    write_report(folder / "second", source=True)
    return folder


@pytest.fixture
def show(browser):
    """Open a page; it must not complain, nor ask the network for anything."""
    complaints, contexts = [], []

    def open_page(path, **settings):
        settings = {"viewport": {"width": 1366, "height": 768}} | settings
        context = browser.new_context(**settings)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda line: complaints.append(line.text))
        page.on("request", lambda asked: complaints.append(asked.url)
                if not asked.url.startswith(("file:", "data:")) else None)  # fmt: skip
        page.goto(Path(path).as_uri())
        page.wait_for_selector("html[data-ready=yes]")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


@pytest.fixture
def page(show, runs):
    return show(runs / "second" / "report.html")


def on_screen(page, place):
    """Where a place is, in pixels of the window."""
    box = page.locator("#map").bounding_box()
    x, y = page.evaluate(
        f"[map.sx(run.place_x_m[{place}]), map.sy(run.place_y_m[{place}])]"
    )  # fmt: skip
    return box["x"] + x, box["y"] + y


def wait_until(page, true):
    """Wait for at most a minute. The page's policy forbids Playwright's own way to do so."""
    for _ in range(1200):
        if page.evaluate(true):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"not {true}")


def let_it_draw(page, frames=3):
    """Wait until the page has drawn so many frames of the screen, however long that takes."""
    page.evaluate(
        """async frames => {
          for (let i = 0; i < frames; i++) await new Promise(requestAnimationFrame);
        }""",
        frames,
    )


def picture(page):
    """The pixels of the map, ``(h, w, 4)``."""
    let_it_draw(page)
    file = page.evaluate("document.getElementById('map').toDataURL()").partition(",")[2]
    data = np.frombuffer(base64.b64decode(file), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED).astype(np.int16)


def changed(one, other) -> int:
    """How many pixels differ, but for those that only edges of lines touch."""
    seen, then = (p[..., :3].astype(int) * p[..., 3:] // 255 for p in (one, other))  # no colour: 0
    coverage = np.abs(one[..., 3] - other[..., 3])
    return int((np.maximum(np.abs(seen - then).max(-1), coverage) > 100).sum())


def test_the_arrays_arrive_as_they_were(page, runs):
    frames = read_frames(runs / "second")
    assert page.evaluate("Array.from(run.row_frame)") == frames["frame"].tolist()
    assert page.evaluate("Array.from(run.row_time_s)") == frames["time_s"].tolist()
    named = "rendered world ellipse (laps 2, width 96, height 24, frames per lap 90)"
    assert page.locator("h1").inner_text() == named


def test_a_click_on_a_place_shows_its_picture_template_links_and_visits(page):
    page.mouse.click(*on_screen(page, 20))
    panel = page.locator("#place")
    assert panel.locator("h3").first.inner_text() == "Experience 20"
    image = panel.locator("img")
    assert image.evaluate("picture => picture.complete && picture.naturalWidth") == 96
    canvas = panel.locator("canvas.template")
    assert canvas.evaluate("c => [c.width, c.height]") == [60, 10]
    drawn = canvas.evaluate("c => Array.from(c.getContext('2d').getImageData(0, 0, 60, 10).data)")
    template = page.evaluate("Array.from(run.templates.slice(600 * run.place_template[20]))")
    assert drawn[::4] == template[:600]
    links = page.evaluate("known.linksOf[20].length")
    assert panel.locator(".chips").first.locator("button").count() == links > 1
    visits = panel.locator(".chips").nth(1).locator("button")
    first = page.evaluate("run.row_frame[known.visits[20][0][0]]")
    visits.first.click()
    assert page.locator("#clock b").inner_text() == f"frame {first}"
    assert page.evaluate("run.row_place[chosen.row]") == 20


def test_a_link_leads_to_the_next_place(page):
    page.mouse.click(*on_screen(page, 20))
    page.locator("#place .chips button").first.click()
    other = page.evaluate("chosen.place")
    assert other in page.evaluate(
        "known.linksOf[20].flatMap(l => [run.link_from[l], run.link_to[l]])"
    )
    assert page.locator("#place h3").first.inner_text() == f"Experience {other}"


def test_the_slider_shows_the_frame_and_the_path_up_to_it(page):
    whole = picture(page)
    page.locator("#slider").fill("60")
    frame = page.evaluate("run.row_frame[60]")
    assert page.locator("#clock b").inner_text() == f"frame {frame}"
    assert f"{frame}," in page.locator("#now dd").first.inner_text()
    assert page.locator("#now img").count() == 1
    assert changed(picture(page), whole) > 1000
    page.locator("#slider").fill("61")
    page.locator("#slider").fill(page.locator("#slider").get_attribute("max"))
    assert changed(picture(page), whole) < 50, "drawn bit by bit or at once, it is the same"


def test_playing_goes_on_by_itself_and_stops_at_the_end(page):
    page.locator("#slider").fill("0")
    page.locator("#speed").select_option("20")
    page.locator("#play").click()
    row = page.evaluate(  # in the page: seen from here, a slow machine may be at the end already
        """() => new Promise(pressed => {
          const look = () => {
            if (chosen.row <= 20) return requestAnimationFrame(look);
            document.getElementById("play").click();
            pressed(chosen.row);
          };
          look();
        })"""
    )
    assert row < page.evaluate("known.rows - 1")
    let_it_draw(page, 5)
    assert page.evaluate("chosen.row") == row
    page.keyboard.press("Escape")
    page.locator("#speed").select_option("500")
    page.locator("#play").click()
    wait_until(page, "chosen.row === known.rows - 1 && !chosen.playing")
    assert page.locator("#play").get_attribute("aria-label") == "Play"


def test_a_loop_closure_is_a_click_away(page):
    page.locator("#tab-loops").click()
    rows = page.locator("#loops tbody tr")
    assert rows.count() == page.evaluate("about.summary.loop_closures") > 2
    rows.nth(2).locator("button").click()
    link = int(rows.nth(2).get_attribute("data-link"))
    assert page.evaluate("chosen.link") == link
    assert page.evaluate("chosen.row") == page.evaluate(f"known.linkRow[{link}]")
    assert page.evaluate("run.row_place[chosen.row]") == page.evaluate(f"run.link_to[{link}]")
    assert "chosen" in rows.nth(2).get_attribute("class")


def test_dragging_moves_the_map_and_the_wheel_zooms_about_the_pointer(page):
    box = page.locator("#map").bounding_box()
    x, y = box["x"] + 300, box["y"] + 200
    place = on_screen(page, 5)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 80, y + 30, steps=5)
    page.mouse.up()
    np.testing.assert_allclose(on_screen(page, 5), np.add(place, (80, 30)), atol=0.01)
    assert page.evaluate("chosen.place") == -1, "to drag is not to pick"
    before = page.evaluate("[map.view.scale, map.wx(380), map.wy(230)]")
    page.mouse.move(box["x"] + 380, box["y"] + 230)
    page.mouse.wheel(0, -200)
    wait_until(page, f"map.view.scale > 1.2 * {before[0]}")
    after = page.evaluate("[map.wx(380), map.wy(230)]")
    np.testing.assert_allclose(after, before[1:], atol=1e-6)
    page.locator("#fit").click()
    np.testing.assert_allclose(on_screen(page, 5), place, atol=0.01)


def test_everything_can_be_reached_by_keys(page):
    page.locator("#map").focus()
    page.keyboard.press("n")
    page.keyboard.press("n")
    assert page.evaluate("chosen.place") == 1
    assert page.locator("#said").inner_text().startswith("Experience 1, ")
    page.keyboard.press("p")
    assert page.evaluate("chosen.place") == 0
    view = page.evaluate("({...map.view})")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("+")
    moved = page.evaluate("({...map.view})")
    assert moved["x"] > view["x"]
    assert moved["scale"] > view["scale"]
    page.keyboard.press("0")
    assert page.evaluate("map.view.scale") == pytest.approx(view["scale"])
    page.keyboard.press("Enter")
    assert page.evaluate("chosen.place") >= 0
    page.keyboard.press("Escape")
    assert page.evaluate("chosen.place") == -1
    page.locator("#tab-place").focus()
    page.keyboard.press("ArrowLeft")
    assert page.locator("#now").is_visible()
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Home")
    assert page.evaluate("chosen.row") == 0
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowRight")
    assert page.evaluate("chosen.row") == 11


def test_a_chart_leads_to_a_frame(page):
    plot = page.locator("#charts .plot").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 40)
    rows = page.evaluate("known.rows")
    assert abs(page.evaluate("chosen.row") - rows / 2) < 0.1 * rows


def test_the_merge_is_reported_and_shown(page):
    card = page.locator("#session-list .card").nth(1)
    assert card.locator("h3").inner_text().startswith("Merged at frame ")
    card.locator("button").click()
    frame = int(card.locator("h3").inner_text().split()[3].rstrip(":"))
    assert page.locator("#clock b").inner_text() == f"frame {frame}"
    assert page.evaluate("chosen.place") == page.evaluate("mergePoints()[0].place")


def test_layers_and_colours_change_what_is_drawn(page):
    page.locator(".layers summary").click()
    before = picture(page)
    page.locator("[data-layer=links]").uncheck()
    assert (picture(page) != before).any()
    page.locator("[data-layer=links]").check()
    assert changed(picture(page), before) == 0
    page.locator("#colouring").select_option("visits")
    assert changed(picture(page), before) > 500


def test_the_planned_path_is_drawn(show, runs, tmp_path):
    out = shutil.copytree(runs / "second", tmp_path / "out")
    assert show(write_report(out)).locator("[data-layer=plan]").count() == 0
    plan(out, "3", start="20")
    page = show(write_report(out))
    assert "planned path" in page.locator("#legend").inner_text()
    page.locator(".layers summary").click()
    drawn = picture(page)
    page.locator("[data-layer=plan]").uncheck()
    without = picture(page)
    assert changed(drawn, without) > 200
    page.locator("[data-layer=plan]").check()
    assert changed(picture(page), drawn) == 0


def test_only_what_differs_can_be_shown_of_the_config(page):
    parts = page.locator(".config-part")
    assert parts.count() > 8
    assert parts.locator("visible=true").count() == 0, "this run has the defaults"
    assert page.locator("#config-list summary").inner_text().startswith("0 of ")
    page.locator("#only").uncheck()
    assert parts.locator("visible=true").count() == parts.count()


def test_on_a_phone_nothing_covers_the_map_and_the_config_is_folded(show, runs):
    page = show(runs / "second" / "report.html", viewport={"width": 400, "height": 800})
    area, legend, nav = (
        page.locator(name).bounding_box() for name in (".map-area", "#legend", ".top nav")
    )
    assert legend["y"] >= area["y"] + area["height"] - 1
    assert legend["y"] + legend["height"] < 800
    assert nav["height"] < 40, "one row of links"
    assert not page.locator(".config-part").first.is_visible()
    assert page.locator("#config-list details").get_attribute("open") is None


def test_curves_that_lie_on_each_other_differ_in_width_and_dash(page):
    keys = page.locator(".chart", has_text="Size of the map").locator(".head i")
    looks = keys.evaluate_all(
        "all => all.map(k => { const s = getComputedStyle(k);"
        " return [s.borderTopWidth, s.borderTopStyle].join(); })"
    )
    assert len(set(looks)) == len(looks) == 3


def test_the_loop_closures_are_drawn_over_the_robot(page):
    order = page.evaluate(
        """() => {
          const seen = [], inner = [drawRobot, drawLoops];
          drawRobot = (...all) => { seen.push("robot"); inner[0](...all); };
          const draw = map.above.draw;
          map.above.draw = (...all) => { seen.push("loops"); draw.apply(map.above, all); };
          map.paint();
          return seen;
        }"""
    )
    assert order == ["robot", "loops"]


def test_it_follows_the_light_or_dark_of_the_system_and_can_be_switched(show, runs):
    page = show(runs / "second" / "report.html", color_scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(ground)
    page.locator("#theme").click()
    light = page.evaluate(ground)
    assert sum(map(int, dark[4:-1].split(","))) < 120
    assert sum(map(int, light[4:-1].split(","))) > 600


@pytest.mark.parametrize("width", [390, 1024, 2560])
def test_nothing_is_wider_than_the_window(width, show, runs):
    page = show(runs / "second" / "report.html")
    page.set_viewport_size({"width": width, "height": 800})
    wait_until(
        page,
        f"innerWidth === {width}"
        " && map.width === map.canvas.parentElement.getBoundingClientRect().width",
    )
    let_it_draw(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("#map").bounding_box()["height"] > 300


def test_it_prints_in_light_colours_on_a_few_pages(show, runs):
    page = show(runs / "second" / "report.html", color_scheme="dark")
    document = page.pdf(format="A4", print_background=True)
    assert document.startswith(b"%PDF")
    assert 2 <= document.count(b"/Type /Page\n") <= 12


def streets(out: Path, n_places: int) -> None:
    """A walk through streets: so many places, and what a run of it would have written."""
    rng, brain = np.random.default_rng(0), NavigationBrain(BrainConfig())
    brain._name_session(Frame(0, 0.0), {})
    brain.view.learn(np.zeros((10, 60)))  # each experience has this view
    brain.leader.update_from_view(ViewMatch(0, -1.0, 0.0, True))
    ways, corner = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)]), 20
    at, way, known, frame = np.zeros(2, int), 0, {}, 0
    side = corner * (int(np.sqrt(n_places / (3 * corner))) + 1)
    with RowWriter.create(out) as output:
        while brain.map.n < n_places:
            turned = 0
            if not (at % corner).any():
                onward = [w for w in range(4) if w != (way + 2) % 4]
                there = [w for w in onward if ((at + ways[w]) % (side + 1) == at + ways[w]).all()]
                way, before = int(rng.choice(there)), way
                turned = (way - before + 1) % 4 - 1
            at = at + ways[way]
            motion = Motion(1.0, np.pi * turned + 0.004 * rng.standard_normal(), 0.5)
            brain.map.move(motion)
            key, cells = (*at.tolist(), way), PoseEstimate(*(at % 21).tolist(), 9 * way)
            action = "link" if key in known else "create"
            if action == "link":
                brain.map.link(known[key])
            else:
                known[key] = brain.map.create(0, cells, frame)
            brain.clock.frame, brain.clock.time_s = frame, 0.5 * frame
            brain.clock.frames_seen += 1
            result = StepResult(
                frame, 0.5 * frame, motion, ViewMatch(-1, -1.0, 0.0, False), action,
                brain.map.current, brain.map.pose, cells, 0, brain.map.n, brain.map.n_links,
            )  # fmt: skip
            output.write(result, Frame(frame, 0.5 * frame), brain)
            frame += 1
    with writing(out) as folder:
        write_results(brain, RunPlan("streets"), RunSaver(folder, out), RunSummary())


def test_a_map_of_five_thousand_places_is_moved_as_a_bitmap(show, tmp_path):
    streets(tmp_path / "out", 5000)
    page = show(write_report(tmp_path / "out", source=True))
    assert page.evaluate("known.places") == 5000
    painted = page.evaluate(
        """async () => {
          let painted = 0;
          const inner = drawPlaces;
          drawPlaces = (...all) => { painted++; inner(...all); };
          for (let i = 0; i < 30; i++) {
            map.pan(i % 10 < 5 ? 9 : -9, 4);
            await new Promise(requestAnimationFrame);
          }
          return painted;
        }"""
    )
    assert painted == 0, "moving draws no place anew"
    place = page.evaluate("map.nearest(400, 300, 1e9)")
    page.mouse.click(*on_screen(page, place))
    assert page.evaluate("chosen.place") == place


def test_populations_show_their_counts_and_their_pictures_as_they_are(show, tmp_path):
    config = BrainConfig(cells="pose+head_direction+speed")
    run(WORLD, tmp_path / "run", config, stop=30, tensorboard=False)
    write_report(tmp_path / "run", source=True)
    page = show(tmp_path / "run" / "report.html")
    cards = page.locator("#population-list .card")
    assert cards.locator("h3").all_inner_texts() == ["head direction", "speed"]
    assert cards.nth(1).locator("dd").first.inner_text() == "32"
    images = page.locator("#population-list img")
    sizes = images.evaluate_all("all => all.map(i => [i.naturalWidth, i.naturalHeight, i.width])")
    assert sizes == [[65, 65, 260], [32, 1, 256]]
    assert set(images.evaluate_all("all => all.map(i => getComputedStyle(i).imageRendering)")) == {
        "pixelated"
    }
    assert page.locator("#to-populations").is_visible()


def test_where_the_page_draws_all_populations_itself_there_is_no_such_section(page):
    assert not page.locator("#populations").is_visible()
    assert not page.locator("#to-populations").is_visible()
