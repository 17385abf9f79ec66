"""The page of a drive: who may ask, what is answered, and that keys move the rover."""

from __future__ import annotations

import base64
import json
import re
import socket
import threading
import time

import jax
import numpy as np
import pytest

from lunar_mjx.cameras.chase import tracks_of
from lunar_mjx.cameras.photometry import Film
from lunar_mjx.cameras.scene import LEVEL_LIGHT, Sun, build_scene
from lunar_mjx.cameras.texture import TINT, TrackPainter
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.terrain import Terrain, build_rocks, flat, sample
from lunar_mjx.viewer.drive import PACE
from lunar_mjx.viewer.scene import ground_scene, rover_scene
from lunar_mjx.viewer.server import SERVER, Viewer
from tests.viewer.viewer_client import ask, pictures

PATHS = ("/", "/main.js", "/scene", "/ground?x=0&y=0", "/pictures", "/nothing")


def test_listens_on_the_loopback_address_only(viewer):
    host, port = viewer.socket.getsockname()
    assert host == "127.0.0.1"
    for other in ("127.0.0.2", socket.gethostbyname(socket.gethostname())):
        if other != host:
            with pytest.raises(OSError), socket.create_connection((other, port)):
                pass


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example:{port}", "127.0.0.1:1", "", "[::1]:{port}"]
)
def test_a_foreign_name_for_this_machine_is_refused(viewer, path, host):
    status, _, text = ask(viewer, "GET", path, Host=host.format(port=viewer.server_address[1]))
    assert status == 403 and viewer.address.encode() in text and len(text) < 200


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "https://127.0.0.1:{port}",
        "http://127.0.0.1:1",
        "null",
        "",
        "http://127.0.0.1:{port}.evil.example",
        "http://localhost",
    ],
)
def test_pages_of_another_origin_are_refused(viewer, origin):
    foreign = origin.format(port=viewer.server_address[1])
    for path in PATHS:
        assert ask(viewer, "GET", path, Origin=foreign)[0] == 403
    viewer.drive.pilot.hold([])
    for path in ("/keys", "/reset"):
        assert ask(viewer, "POST", path, {"held": ["forward"]}, Origin=foreign)[0] == 403
    assert viewer.drive.pilot.throttle == 0.0


def test_what_another_site_asks_for_without_an_origin_is_refused(viewer):
    """A script or picture element sends no Origin; a link that is clicked may open the page, though not in a frame."""
    for site in ("cross-site", "same-site"):
        assert ask(viewer, "GET", "/main.js", Sec_Fetch_Site=site, Sec_Fetch_Mode="no-cors")[0] == 403
        assert ask(viewer, "POST", "/reset", {}, Sec_Fetch_Site=site, Sec_Fetch_Mode="navigate")[0] == 403
        status, headers, _ = ask(viewer, "GET", "/", Sec_Fetch_Site=site, Sec_Fetch_Mode="navigate")
        assert status == 200 and headers["X-Frame-Options"] == "DENY"
    # a form of another page can send text, but not JSON
    assert ask(viewer, "POST", "/reset", "x", Content_Type="text/plain")[0] == 415


def test_its_own_page_is_answered(viewer):
    own = viewer.address.rstrip("/")
    status, headers, page = ask(viewer, "GET", "/", Origin=own, Sec_Fetch_Site="same-origin")
    assert status == 200 and "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    wanted = re.findall(r'(?:src|href)="(/[^"]+)"', page.decode())
    scripts = ask(viewer, "GET", "/main.js")[2].decode()
    wanted += ["/" + name for name in re.findall(r'from "\./([^"]+)"', scripts)]
    assert len(wanted) >= 6
    for path in wanted:
        assert ask(viewer, "GET", path)[0] == 200, path
    port = viewer.server_address[1]
    assert ask(viewer, "GET", "/", Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200


@pytest.mark.parametrize("path", PATHS[:2])
def test_nothing_is_asked_of_the_internet(viewer, path):
    text = ask(viewer, "GET", path)[2].decode()
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "") and "https://" not in text


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/keys", {"held": ["fly"]}, 400),
        ("/keys", {"held": [["forward"]]}, 400),
        ("/keys", {"held": "forward"}, 400),
        ("/keys", [], 400),
        ("/keys", "{", 400),
        ("/keys", "[" * 3000, 400),
        ("/keys", "9" * 5000, 400),
        ("/elsewhere", {}, 400),
        ("/reset", {}, 200),
    ],
)
def test_messages_are_checked(viewer, path, body, status):
    assert ask(viewer, "POST", path, body)[0] == status


@pytest.mark.parametrize("query", ["", "?x=1", "?x=nan&y=0", "?x=a&y=0", "?x=inf&y=1"])
def test_places_are_checked(viewer, query):
    assert ask(viewer, "GET", f"/ground{query}")[0] == 400


def test_files_beside_the_page_are_not_served(viewer):
    for path in ("/../server.py", "/%2e%2e/server.py", "/page/index.html", "//etc/passwd", "/index.html/"):
        assert ask(viewer, "GET", path)[0] in (403, 404)


def test_ground_is_the_terrains(viewer):
    near = json.loads(ask(viewer, "GET", "/ground?x=3&y=-4")[2])["near"]
    heights = np.frombuffer(base64.b64decode(near["heights"]), "<f4").reshape(near["rows"], near["cols"])
    x = np.linspace(near["low"][0], near["high"][0], near["cols"])
    y = np.linspace(near["low"][1], near["high"][1], near["rows"])
    assert x[0] < 3 - 19 and x[-1] > 3 + 19 and y[0] < -4 - 19 and y[-1] > -4 + 19
    found = sample(viewer.drive.model.terrain.field, *(a.astype(np.float32) for a in np.meshgrid(x, y)))[0]
    np.testing.assert_allclose(heights, found, atol=2e-3)
    assert json.loads(ask(viewer, "GET", "/ground?x=1e9&y=0")[2])["near"]["cols"] > 1  # off the map: its edge


def test_rocks_are_sent_as_far_as_pictures_show_them():
    """Fine ground ends 20 m away; a boulder 50 m away is sent, and one 100 m away is not."""
    ground = flat(240.0)
    centres = np.array([[5.0, 0.0, 0.3], [50.0, 0.0, 0.3], [100.0, 0.0, 0.3]])
    rocks = build_rocks(centres, np.full(3, 0.8), (-120.0, -120.0, 120.0, 120.0))
    terrain = jax.device_get(Terrain(ground.field, rocks, None, np.zeros(3), "boulders"))
    assert sorted(rock[0] for rock in ground_scene(terrain, 0.0, 0.0)["rocks"]) == [5.0, 50.0]


def test_the_page_is_told_the_scene_of_the_other_cameras():
    """Sun, rocks and tracks of the page are those of MuJoCo's scene and of the painter of tracks."""
    ground, sun = flat(60.0), Sun(200.0, 8.0)
    centres = np.array([[5.0, 1.0, 0.2], [-8.0, 3.0, 0.1]])
    rocks = build_rocks(centres, np.array([0.5, 0.8]), (-30.0, -30.0, 30.0, 30.0))
    terrain = jax.device_get(Terrain(ground.field, rocks, None, np.zeros(3), "boulders"))
    model = make_model("luvmi_x", "flat")
    drawn, _ = build_scene(model.rover, terrain, np.zeros((1, 2)), sun)
    told = rover_scene(model, sun)
    np.testing.assert_allclose(told["sun"], -drawn.light_dir[0], atol=1e-6)
    # level soil: as bright on the screen as the film of the cameras in JAX has it, and as MuJoCo's light shows it
    on_page = [c * (told["light"]["exposure"] * told["sun"][2] + told["light"]["fill"]) for c in told["soil"]]
    lit, film = drawn.light_diffuse[0, 0] / LEVEL_LIGHT * told["sun"][2], Film()
    np.testing.assert_allclose(on_page, lit * film.mid * TINT, rtol=0.02)
    assert told["light"]["gamma"] == film.gamma
    balls = [g for g in range(drawn.ngeom) if drawn.geom(g).name.startswith("rock_")]
    sent = np.array(sorted(ground_scene(terrain, 0.0, 0.0)["rocks"]))
    found = np.array(sorted([*drawn.geom_pos[g], drawn.geom_size[g, 0]] for g in balls))
    np.testing.assert_allclose(sent[:, :3], found[:, :3], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(sent[:, 3:6], axis=1), found[:, 3], atol=1e-3)
    # a track along x over white ground, a texel every centimetre
    way = np.stack([np.linspace(-4.0, 4.0, 401), np.zeros(401)], axis=-1)
    wheel, side = told["wheels"][0], 1000
    (track, *_) = tracks_of(model.rover, np.repeat(way[:, None], len(model.rover.wheels), axis=1))
    white = np.full((side, side, 3), 255, np.uint8)
    along = TrackPainter(white, (-5.0, -5.0), (10.0, 10.0), [track]).paint(401)[side // 2, :, 0] / 255.0
    assert set(along.round(3)) == {1.0, *(round(shade, 3) for shade in told["tracks"].values())}
    prints = np.flatnonzero(np.diff((along < told["tracks"]["rut"] - 0.01).astype(int)) == 1)
    assert np.diff(prints).mean() == pytest.approx(100.0 * wheel["pitch"], rel=0.05)


def _drive(viewer, clock, seconds):
    """Lets time go by, tick by tick; returns the pictures."""
    shown = []
    for _ in range(round(seconds / PACE.tick)):
        clock.now += PACE.tick
        viewer.pace.tick()
        shown.append(json.loads(viewer.next_picture(0)[1]))
    return shown


def test_keys_move_the_rover_and_a_silent_page_lets_go(viewer, clock):
    ask(viewer, "POST", "/reset", {})
    still = _drive(viewer, clock, 1.0)[-1]
    assert still["path_m"] < 0.05 and still["asked_m_s"] == 0.0
    assert ask(viewer, "POST", "/keys", {"held": ["forward", "left"]})[0] == 200
    driven = _drive(viewer, clock, SERVER.dead_man)
    assert all(p["asked_m_s"] > 0 for p in driven[:-1])
    assert ask(viewer, "POST", "/keys", {"held": ["forward", "left"]})[0] == 200
    last = _drive(viewer, clock, 0.9 * SERVER.dead_man)[-1]
    assert last["asked_m_s"] > 0 and last["speed_m_s"] > 0.05 and 0.0 < last["heading_deg"] < 90.0
    assert last["path_m"] > 0.1 and last["bodies"][1][0] > still["bodies"][1][0] + 0.05
    assert len(last["slip"]) == len(last["sinkage_mm"]) == len(last["winding_degC"]) == 4
    assert max(last["sinkage_mm"]) > 1.0 and last["hottest_degC"] > 20.0
    # nothing more is said: after SERVER.dead_man the keys are let go and the rover stops
    silent = _drive(viewer, clock, 3.0)
    released = next(p for p in silent if p["asked_m_s"] == 0.0)
    assert released["time_s"] == pytest.approx(last["time_s"] + 0.1 * SERVER.dead_man, abs=2 * PACE.tick)
    assert all(p["asked_m_s"] == 0.0 for p in silent if p["time_s"] > released["time_s"])
    assert silent[-1]["speed_m_s"] < 0.05
    ask(viewer, "POST", "/reset", {})
    assert _drive(viewer, clock, PACE.tick)[-1]["path_m"] < 0.05


def test_the_page_gets_every_new_picture(viewer, clock):
    _drive(viewer, clock, PACE.tick)
    stream = pictures(viewer)
    for _ in range(5):
        time_s = next(stream)["time_s"]
        assert time_s == pytest.approx(viewer.drive.time, abs=1e-4)
        _drive(viewer, clock, PACE.tick)
    stream.close()


def test_many_who_connect_and_say_nothing_do_not_shut_the_page_out(viewer, clock):
    """Neither do they get threads without bound; a page that listens meanwhile is not cut off."""
    _drive(viewer, clock, PACE.tick)
    stream = pictures(viewer)
    next(stream)
    before = threading.active_count()
    silent = [socket.create_connection(viewer.server_address) for _ in range(600)]
    for i, connection in enumerate(silent):
        if i % 2:
            connection.send(b"GET / HTTP/1.1\r\nHost: ")
    most = 0
    for _ in range(5):
        began = time.process_time()
        assert ask(viewer, "GET", "/style.css")[0] == 200
        assert time.process_time() - began < 1.0, "seconds of the processor, of all threads together"
        most = max(most, threading.active_count())
        _drive(viewer, clock, PACE.tick)
        assert next(stream)["time_s"] == pytest.approx(viewer.drive.time, abs=1e-4)
    assert most <= before + 64
    for connection in silent:
        connection.close()
    stream.close()


def test_a_taken_port_is_one_sentence(viewer):
    with pytest.raises(UserError, match=r"--port = \d+ cannot be opened \(Address already in use\); name another port"):
        Viewer(viewer.drive, viewer.server_address[1])
    with pytest.raises(UserError, match="--port = 70000 is no port"):
        Viewer(viewer.drive, 70000)


def test_pictures_end_with_the_drive(viewer):
    served = Viewer(viewer.drive, 0)
    served._show()
    runner = threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.1})
    runner.start()
    stream = pictures(served)
    assert next(stream)
    served.shutdown()
    served.close()
    assert not list(stream)
    runner.join()
