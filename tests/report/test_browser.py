"""The pages in a real browser: from a file, without a network, light and dark, on a desk and on a phone."""

from __future__ import annotations

import os

import browser
import pytest

from graphnav.app import cli

PAGES = ("comparison.html", "batch/report.html", "stops/detections.html")
SPAN = "gnss:60-80"


@pytest.fixture(scope="session")
def pages(tmp_path_factory):
    """Reports of two minutes of a real drive."""
    out = tmp_path_factory.mktemp("pages")
    part = ["kitti", "--end", "120", "--quiet", "--without", SPAN]
    assert cli.run(["compare", *part, "-o", str(out)]) == 0
    assert cli.run(["detect", *part, "-o", str(out / "stops")]) == 0
    return out


@pytest.fixture(scope="module")
def tab():
    """A browser; without one the test is skipped, except in CI, where that would hide a failure."""
    if browser.find() is None:
        reason = f"no browser: none of {', '.join(browser.NAMES)} is installed"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    with browser.browser() as one:
        yield one


def checked(tab, width):
    """What holds for every page: nothing went wrong, nothing was fetched, nothing sticks out, all can be read."""
    assert tab.trouble == []
    assert [url for url in tab.asked if not url.startswith(("file:", "data:", "blob:"))] == []
    assert tab.run("document.documentElement.scrollWidth") <= width
    # numbers between the decades of a logarithmic axis are smaller, and may be
    words = "[...document.querySelectorAll('.plot .annotation-text, .plot .xtick text')]"
    assert tab.run(f"Math.min(...{words}.map(t => parseFloat(getComputedStyle(t).fontSize)))") > 9.0


@pytest.mark.parametrize("size", [browser.DESKTOP, browser.PHONE], ids=["desktop", "phone"])
@pytest.mark.parametrize("page", PAGES)
def test_every_picture_comes_alive_in_both_colours(tab, pages, page, size):
    tab.open(pages / page, size)
    tab.wait("document.documentElement.dataset.ready !== undefined")
    tab.read()
    checked(tab, size[0])
    ink = "getComputedStyle(document.querySelector('.js-plotly-plot .xtick text')).fill"
    wanted = "(p => (p.style.color = 'var(--soft)', getComputedStyle(p).color))(document.querySelector('nav'))"
    light = tab.run(ink)
    assert light == tab.run(wanted)
    tab.colours(dark=True)
    tab.wait(f"{ink} !== '{light}'")
    assert tab.run(ink) == tab.run(wanted)
    checked(tab, size[0])


def test_the_first_number_of_a_table_is_seen_on_a_phone(tab, pages):
    """Beside a long name, without scrolling sideways."""
    tab.open(pages / "batch/report.html", browser.PHONE)
    cells = "[...document.querySelectorAll('section td:nth-child(2):not(.words)')].filter(c => c.offsetParent)"
    assert tab.run(f"{cells}.length") > 20
    assert tab.run(f"Math.max(...{cells}.map(c => c.getBoundingClientRect().right))") < browser.PHONE[0]


def test_without_scripts_a_page_says_what_is_missing(tab, pages):
    tab.open(pages / "batch/report.html", browser.PHONE, scripts=False)
    assert tab.run("document.querySelector('main noscript').innerText").strip()
    assert tab.run("document.querySelectorAll('table').length") > 5
    assert tab.trouble == []


def test_a_page_that_is_just_loaded_can_be_printed(tab, pages):
    """As `chromium --print-to-pdf` does: all is unpacked when the page says that it is loaded."""
    tab.open(pages / "batch/report.html")
    assert tab.run("document.documentElement.dataset.ready !== undefined && !!window.Plotly")
    library = "new TextEncoder().encode(document.head.querySelector('script').textContent).length"
    assert tab.run(library) == tab.run("Number(document.getElementById('plotly-library').dataset.size)")


def test_printing_draws_every_figure_that_is_not_folded(tab, pages):
    tab.open(pages / "batch/report.html")
    tab.wait("document.documentElement.dataset.ready !== undefined")
    tab.run("dispatchEvent(new Event('beforeprint'))")
    shown = browser.PLOTS
    assert tab.run(f"{shown}.length") > 8
    assert tab.run(f"{shown}.every(p => p.querySelector('.main-svg').clientWidth <= 703)")
    before = tab.run(f"{shown}.map(p => p.dataset.height)")
    tab.run("dispatchEvent(new Event('afterprint'))")
    assert tab.run(f"{shown}.map(p => p.style.height)") == before
    assert tab.trouble == []


def test_hovering_zooming_and_hiding(tab, pages):
    tab.open(pages / "comparison.html")
    place = "[...document.querySelectorAll('figure')].find(f => f.innerText.startsWith('Position error'))"
    tab.run(f"{place}.scrollIntoView()")
    tab.wait(f"!!{place}.querySelector('.js-plotly-plot .plotly')")
    box = tab.run(f"(r => [r.left, r.top, r.width, r.height])({place}.querySelector('.plot').getBoundingClientRect())")
    x, y = box[0] + 0.5 * box[2], box[1] + 0.2 * box[3]
    tab.mouse("mouseMoved", x, y)
    tab.mouse("mouseMoved", x + 3, y)
    tab.wait(f"{place}.querySelectorAll('.hoverlayer .hovertext').length > 0")
    spread = f"(r => r[1] - r[0])({place}.querySelector('.plot').layout.xaxis.range)"
    whole = tab.run(spread)
    tab.mouse("mousePressed", x, y)
    for step in range(1, 6):
        tab.mouse("mouseMoved", x + 30 * step, y, pressed=True)
    tab.mouse("mouseReleased", x + 150, y)
    tab.wait(f"{spread} < 0.6 * {whole}")
    # one time axis: another figure has gone along
    other = "[...document.querySelectorAll('figure')].find(f => f.innerText.startsWith('Position, 1 sigma'))"
    tab.run(f"{other}.scrollIntoView()")
    tab.wait(f"!!{other}.querySelector('.js-plotly-plot .plotly')")
    limits = "(f => f.querySelector('.plot').layout.xaxis.range)"
    assert tab.run(f"{limits}({other})") == pytest.approx(tab.run(f"{limits}({place})"))
    # and the cursor, which is at the time under the mouse in both
    left, top, width, height = tab.run(
        f"(r => [r.left, r.top, r.width, r.height])({other}.querySelector('.nsewdrag').getBoundingClientRect())"
    )
    for x in (0.49, 0.5):
        tab.mouse("mouseMoved", left + x * width, top + 0.5 * height)
    tab.wait(f"{place}.querySelector('.cursor')?.hidden === false")
    tab.run(f"void Plotly.relayout({other}.querySelector('.plot'), {{'xaxis.range': [10, 20]}})")
    tab.wait(f"{limits}({place})[0] === 10")
    at = "(p => (p.querySelector('.cursor').offsetLeft - p._fullLayout.xaxis._offset) / p._fullLayout.xaxis._length)"
    tab.wait(f"[{place}, {other}].every(f => Math.abs({at}(f.querySelector('.plot')) - 0.5) < 0.05)")
    # the same on the recording's clock, and back
    choose = "(k => (k.selectedIndex = {}, k.dispatchEvent(new Event('change'))))(document.getElementById('clock'))"
    start = tab.run("Number(document.getElementById('clock').options[1].value)")
    tab.run(choose.format(1))
    assert tab.run(f"{limits}({place})") == pytest.approx([start + 10.0, start + 20.0])
    assert tab.run(f"{limits}({other})") == pytest.approx([start + 10.0, start + 20.0])
    tab.run(choose.format(0))
    assert tab.run(f"{limits}({place})") == pytest.approx([10.0, 20.0])
    shown = f"{place}.querySelector('.plot').data.filter(t => t.legendgroup === 'ekf').map(t => t.visible !== false)"
    assert tab.run(shown) == [True] * 3
    tab.run(f"[...{place}.querySelectorAll('button')].find(b => b.innerText === 'ekf').click()")
    assert tab.run(shown) == [False] * 3
    assert tab.trouble == []
