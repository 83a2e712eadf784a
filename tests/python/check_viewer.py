"""Looks at the viewer's tree in a browser: points are where the engine sees them, and clicks tell lengths and diameters.

    python3 check_viewer.py EXPECTED.json PICTURE.png   # made by tests/cli/tree_pages.rs
"""
import json
import sys

import numpy as np
from browser import Page
from tree_numbers import doubt_of, measure, numbers_of

NEAR_PX = 0.05

expected = json.load(open(sys.argv[1]))
tree = json.load(open(expected["tree"]))["phases"]


def lines(page):
    """Points of each line, pixels."""
    points = page.evaluate("[...document.querySelectorAll('#tree polyline')].map(l => l.getAttribute('points'))")
    return [np.array([[float(v) for v in pair.split(",")] for pair in line.split()]) for line in points]


with Page(expected["url"]) as page:
    page.wait("document.body.dataset.drawn > 0")
    assert lines(page) == [], "lines come when they are asked for"
    page.evaluate("document.getElementById('tree-shown').click()")
    page.wait("document.querySelectorAll('#tree polyline').length > 0")

    for case in expected["cases"]:
        drawn = page.evaluate("+document.body.dataset.drawn")
        page.evaluate(f"change({json.dumps(case['state'])})")
        page.wait(f"document.body.dataset.drawn > {drawn} && !busy")
        found = lines(page)
        assert len(found) == len(case["lines"]), (len(found), len(case["lines"]))
        away = max(np.abs(a - np.array(b)).max() for a, b in zip(found, case["lines"]))
        print(f"{case['state']}: {away:.4f} px off at most")
        assert away < NEAR_PX, (case["state"], away)

    # A click on the middle of each branch, at the last case's whole phase.
    phase = int(expected["cases"][-1]["state"]["phase"])
    for branch, line in enumerate(lines(page)):
        i = len(line) // 2
        place = page.evaluate(f"(() => {{ const p = new DOMPoint({line[i][0]}, {line[i][1]}).matrixTransform("
                              "document.getElementById('tree').getScreenCTM()); return [p.x, p.y]; })()")
        page.click(*place)
        told = page.evaluate("document.getElementById('tree-text').textContent")
        print(told)
        assert told.startswith(f"Branch {branch}:"), (branch, told)
        wanted = measure(tree[phase]["branches"][branch], i)
        # Where a vessel runs along the view, a pixel is more of its length.
        assert np.allclose(numbers_of(told), wanted, atol=1.0), (told, wanted)
        assert np.allclose(numbers_of(told)[:3], wanted[:3], atol=0.06), (told, wanted)
        doubt = tree[phase]["branches"][branch]
        assert np.allclose(doubt_of(told), [doubt["doubt_mm"][i], 100 * doubt["existence"][i]], atol=0.6), told
        chosen = page.evaluate("[...document.querySelectorAll('#tree polyline')].findIndex(l => l.matches('.chosen'))")
        assert chosen == branch, (chosen, branch)
    page.picture(sys.argv[2])

    # Doubt: an interval for each point, and each step of a centreline in one of the colours.
    def strokes(kind):
        return page.evaluate(f"[...document.querySelectorAll('#tree .{kind}')].map(p => (p.getAttribute('d') || '').split('M').length - 1)")

    assert strokes("interval") == [0] and sum(strokes("level")) == 0
    page.evaluate("document.getElementById('doubt-shown').click()")
    branches = tree[phase]["branches"]
    assert strokes("interval") == [sum(len(b["points_mm"]) for b in branches)], strokes("interval")
    bounds = [0.25, 0.5, 1, 2, 4, np.inf]
    wanted = [0] * len(bounds)
    for b in branches:
        for doubt in (np.array(b["doubt_mm"][1:]) + b["doubt_mm"][:-1]) / 2:
            wanted[np.searchsorted(bounds, doubt)] += 1
    assert strokes("level") == wanted, (strokes("level"), wanted)
    assert "to 0.25 mm" in page.evaluate("document.getElementById('doubt-legend').textContent")
    page.picture(sys.argv[2].replace(".png", "-doubt.png"))
    page.evaluate("document.getElementById('doubt-shown').click()")
    assert strokes("interval") == [0] and sum(strokes("level")) == 0

    # The next view for the clicked branch, then for all vessels.
    last = len(lines(page)) - 1
    for whom in (f"For branch {last}:", "For all vessels:"):
        page.evaluate("document.getElementById('next').click()")
        page.wait("document.querySelectorAll('#suggested button').length > 0")
        assert page.evaluate("document.getElementById('suggested').textContent").startswith(whom)
        best = page.evaluate("JSON.stringify(plan.suggested[0])")
        best = json.loads(best)
        texts = page.evaluate("[...document.querySelectorAll('#suggested button')].map(b => b.textContent)")
        print(whom, texts)
        assert 1 <= len(texts) <= 3 and f"doubt removed {round(100 * best['doubt_removed'])}\u00a0%" in texts[0], texts
        drawn = page.evaluate("+document.body.dataset.drawn")
        page.evaluate("document.querySelector('#suggested button').click()")
        page.wait(f"document.body.dataset.drawn > {drawn} && !busy")
        assert page.evaluate("[state.primary, state.secondary]") == [best["primary_deg"], best["secondary_deg"]]
        # A click on the map's corner at the lower left turns the C-arm to the lowest angles.
        corner = page.evaluate("(() => { const b = document.getElementById('map').getBoundingClientRect();"
                               " return [b.left + 1, b.bottom - 1]; })()")
        page.evaluate(f"document.getElementById('map').dispatchEvent(new MouseEvent('click', "
                      f"{{clientX: {corner[0]}, clientY: {corner[1]}}}))")
        assert page.evaluate("[state.primary, state.secondary]") == [-90, -40]
        page.evaluate("place = null")
    page.wait("!busy")
    page.picture(sys.argv[2].replace(".png", "-next.png"))

    page.evaluate("document.getElementById('tree-shown').click()")
    assert lines(page) == [] and page.evaluate("document.getElementById('tree-text').textContent") == ""

# An address may ask for it.
first = expected["cases"][0]["state"]
address = expected["url"] + "".join(f"&{name}={value}" for name, value in first.items()) + "&tree=1"
with Page(address) as page:
    page.wait("document.querySelectorAll('#tree polyline').length > 0")
    away = max(np.abs(a - np.array(b)).max() for a, b in zip(lines(page), expected["cases"][0]["lines"]))
    assert away < NEAR_PX, away
