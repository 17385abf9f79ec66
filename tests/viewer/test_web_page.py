"""The page in a real browser: the rover is drawn, and a key that is pressed drives it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from PIL import Image

from lunar_mjx.cameras.photometry import Film
from lunar_mjx.viewer.drive import PACE
from lunar_mjx.viewer.server import SERVER

pytestmark = pytest.mark.slow


def _number(browser, element):
    return float(browser.value(f"document.getElementById('{element}').textContent").split()[0].replace("−", "-"))


def _drive_until(browser, viewer, clock, expression, may_go=lambda: True):
    """Drives tick by tick until the page tells what is asked for; nothing has to be drawn for that."""
    for _ in range(browser.most_frames):
        if browser.value(f"Boolean({expression})"):
            return
        if may_go():
            clock.now += PACE.tick
            viewer.pace.tick()
    raise TimeoutError(expression)


EASED = """(() => {
  const now = performance.now();
  window.eased = (window.eased ?? 0) + Math.min(now - (window.looked ?? now), 200);
  window.looked = now;
  return window.eased > 1000;
})()"""
"""Whether the page has drawn for a second, of which a picture counts 0.2 s at most: the camera has caught up then."""


def test_keys_drive_what_the_page_shows(viewer, clock, browser, tmp_path, monkeypatch):
    """By the test's own clock: in real time a busy machine tells of held keys too late, and the rover is stopped."""
    told, taken = [clock.now], viewer.hold

    def hold(keys):
        taken(keys)
        told.append(clock.now)

    monkeypatch.setattr(viewer, "hold", hold)
    browser.resize(320, 190)  # quickly drawn where no graphics card does it
    browser.open(viewer.address)
    _drive_until(browser, viewer, clock, "Number(document.body?.dataset.pictures) > 3")
    assert browser.value("document.getElementById('title').textContent") == "luvmi_x on lunar_plain"
    assert browser.value("document.querySelectorAll('#wheels tbody tr').length") == 4
    assert browser.value("document.getElementById('note').hidden")
    before = _number(browser, "path")
    browser.key("keyDown", "ArrowUp", "ArrowUp")
    driven = f"parseFloat(document.getElementById('path').textContent) > {before + 0.3}"
    moves = "parseFloat(document.getElementById('speed').textContent) > 0.05"
    held = "document.querySelector('[data-key=forward]').className === 'held'"
    # The clock waits for the page to tell again that the key is held, as it does in time on a machine that is idle.
    fresh = 0.5 * SERVER.dead_man
    _drive_until(browser, viewer, clock, f"{driven} && {moves} && {held}", lambda: clock.now < told[-1] + fresh)
    browser.wait(EASED)
    browser.resize(1280, 760)
    browser.wait("document.getElementById('view').width === 1280")
    picture = browser.picture(tmp_path / "page.png")
    browser.key("keyUp", "ArrowUp", "ArrowUp")
    _drive_until(browser, viewer, clock, "parseFloat(document.getElementById('speed').textContent) < 0.05")

    shown = np.asarray(Image.open(picture).convert("RGB"), float)
    sky, ground = shown[10:60, 500:800], shown[600:640, 700:1200]
    # the sky of the other cameras: black, and nothing draws stars
    assert np.median(sky) == 0
    assert not browser.value("fetch('/render.js').then(r => r.text()).then(t => /\\bstars?\\b/i.test(t))")
    # gently sloping soil: as bright as level soil in the other cameras, and mottled
    assert abs(np.median(ground) / 255 / Film().mid ** (1 / Film().gamma) - 1) < 0.15 and ground.std() > 2
    # the rover's blue top, between the panels
    seen = shown[165:600]
    assert (seen[..., 2] > seen[..., 0] + 25).sum() > 2000

    browser.key("keyDown", "KeyR", "r")
    _drive_until(browser, viewer, clock, "parseFloat(document.getElementById('path').textContent) < 0.1")
    browser.value("document.getElementById('camera').click()")
    assert browser.value("document.getElementById('camera').textContent") == "camera: fixed"
    assert not browser.problems


def test_far_rocks_are_one_mesh_of_their_own_shapes(live_viewer, browser):
    """Two ellipsoids, one turned: every corner lies on its own surface, and normals point along its gradient."""
    browser.open(live_viewer.address)
    browser.wait("Number(document.body?.dataset.pictures) > 0")
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    rocks = [(np.array([40.0, -30.0, 0.2]), np.eye(3), np.ones(3)), (np.array([5.0, 50.0, 0.1]), turn, [0.9, 0.5, 0.3])]
    given = [[*centre, *(axes * np.asarray(length)).T.ravel()] for centre, axes, length in rocks]
    mesh = browser.value(f"import('/shapes.js').then(m => m.pebbles({[[float(v) for v in g] for g in given]}))")
    places, normals = (np.reshape(mesh[k], (2, -1, 3)) for k in ("places", "normals"))
    assert max(mesh["index"]) == places[0].shape[0] * 2 - 1
    for (centre, axes, length), corners, out in zip(rocks, places, normals, strict=True):
        own = (corners - centre) @ axes / length
        np.testing.assert_allclose(np.linalg.norm(own, axis=1), 1.0, atol=1e-6)
        gradient = (own / length) @ axes.T
        np.testing.assert_allclose(out, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), atol=1e-6)
    assert not browser.problems


def test_a_page_from_elsewhere_can_neither_read_nor_drive(live_viewer, browser):
    """The browser's own rules and the server's together, from a page without an origin of ours."""
    live_viewer.drive.pilot.hold([])
    browser.open("data:text/html,<p>elsewhere")
    browser.wait("document.body?.textContent === 'elsewhere'")
    forward = "{method: 'POST', mode: 'no-cors', body: '{\"held\": [\"forward\"]}'}"
    for path, options in (("scene", "{}"), ("scene", "{mode: 'no-cors'}"), ("keys", forward)):
        ask = f"fetch('{live_viewer.address}{path}', {options}).then(r => r.text(), () => '')"
        assert browser.value(ask) == ""
    assert live_viewer.drive.pilot.throttle == 0.0


@pytest.mark.parametrize(
    "size", [(360, 740), (500, 900), (740, 360), (1280, 760)], ids=["phone", "large phone", "phone, lying", "desk"]
)
def test_panels_stay_in_the_window_and_off_each_other(live_viewer, browser, size):
    browser.resize(*size)
    browser.open(live_viewer.address)
    browser.wait("Number(document.body?.dataset.pictures) > 3")
    boxes = browser.value(
        "[...document.querySelectorAll('section')].filter(s => s.checkVisibility() && s.getClientRects().length)"
        ".map(s => { const b = s.getBoundingClientRect(); return [s.id, b.left, b.top, b.right, b.bottom]; })"
    )
    assert len(boxes) >= 2
    beyond = browser.value(
        "[...document.querySelectorAll('section')].filter(s => s.scrollWidth > s.clientWidth + 1).map(s => s.id)"
    )
    assert beyond == []  # what a panel holds lies within it
    for name, left, top, right, bottom in boxes:
        assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1], name
    for (a, *one), (b, *other) in itertools.combinations(boxes, 2):
        wide = min(one[2], other[2]) - max(one[0], other[0])
        high = min(one[3], other[3]) - max(one[1], other[1])
        assert wide <= 0 or high <= 0, (a, b)
    assert browser.asked() and all(r.startswith(live_viewer.address) for r in browser.asked())
