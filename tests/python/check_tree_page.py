"""Looks at a run's page in a browser that reaches nothing else: the tree lies on the angiograms, and clicks tell of branches.

    python3 check_tree_page.py EXPECTED.json PICTURE.png   # made by tests/cli/tree_pages.rs
"""
import base64
import io
import json
import re
import sys

import numpy as np
from PIL import Image
from browser import Page
from tree_numbers import doubt_of, measure, numbers_of

NEAR_PX = 0.05

expected = json.load(open(sys.argv[1]))
tree = json.load(open(expected["tree"]))["phases"]
source = open(expected["page"]).read()
addresses = set(re.findall(r"(?:https?:)?//[\w.]+[^\s\"'<>]*", re.sub(r"base64,[\w+/=]*", "", source)))
# The name of SVG's language, which nobody visits.
assert addresses == {"http://www.w3.org/2000/svg"}, addresses
assert not re.search(r"<link|@import|<script[^>]*\ssrc|<img[^>]*\ssrc=\"(?!data:)", source)


def lines(page, view):
    points = page.evaluate(f"[...document.querySelectorAll('#tree-views svg')[{view}].querySelectorAll('polyline')]"
                           ".map(l => l.getAttribute('points'))")
    return [np.array([[float(v) for v in pair.split(",")] for pair in line.split()]) for line in points]


def choose_phase(page, phase):
    page.evaluate(f"(() => {{ const s = document.getElementById('tree-phase'); s.value = {phase};"
                  " s.dispatchEvent(new Event('input')); })()")


with Page("file://" + expected["page"]) as page:
    page.wait("document.querySelectorAll('#tree-views polyline').length > 0")
    assert page.evaluate("document.querySelectorAll('#tree-views svg').length") == len(expected["views"])
    for view, frames in enumerate(expected["views"]):
        for frame in frames:
            choose_phase(page, frame["phase"])
            found = lines(page, view)
            assert len(found) == len(frame["lines"])
            away = max(np.abs(a - np.array(b)).max() for a, b in zip(found, frame["lines"]))
            assert away < NEAR_PX, (view, frame["phase"], away)
            caption = page.evaluate(f"document.querySelectorAll('#tree-views figcaption')[{view}].textContent")
            assert caption.endswith(f"phase {frame['phase']}"), caption
            shown = page.evaluate(f"document.querySelectorAll('#tree-views image')[{view}].getAttribute('href')")
            shown = np.array(Image.open(io.BytesIO(base64.b64decode(shown.split("base64,")[1]))), float).ravel()
            like = np.corrcoef(shown, -np.array(frame["integrals"]))[0, 1]
            assert like > 0.999, (view, frame["phase"], like)

    phase, view = 1, len(expected["views"]) - 1
    choose_phase(page, phase)
    for branch, line in enumerate(lines(page, view)):
        i = len(line) // 2
        svg = f"document.querySelectorAll('#tree-views svg')[{view}]"
        page.evaluate(svg + ".scrollIntoView()")
        place = page.evaluate(f"(() => {{ const p = new DOMPoint({line[i][0]}, {line[i][1]}).matrixTransform("
                              f"{svg}.getScreenCTM()); return [p.x, p.y]; }})()")
        page.click(*place)
        told = page.evaluate("document.getElementById('tree-told').textContent")
        print(told)
        assert told.startswith(f"Branch {branch}:") and told.endswith(f"(phase {phase})."), (branch, told)
        wanted = measure(tree[phase]["branches"][branch], i)
        # Where a vessel runs along the view, a pixel is more of its length.
        assert np.allclose(numbers_of(told), wanted, atol=1.0), (told, wanted)
        assert np.allclose(numbers_of(told)[:3], wanted[:3], atol=0.06), (told, wanted)
        doubt = tree[phase]["branches"][branch]
        assert np.allclose(doubt_of(told), [doubt["doubt_mm"][i], 100 * doubt["existence"][i]], atol=0.6), told
        chosen = page.evaluate("[...document.querySelectorAll('tr.chosen')].map(r => +r.dataset.branch)")
        assert chosen and set(chosen) == {branch}, (chosen, branch)
    page.picture(sys.argv[2])

    rows = page.evaluate("[...document.querySelectorAll('tr[data-branch]')].map(r => [+r.dataset.phase, +r.dataset.branch,"
                         " ...[...r.cells].slice(2).map(c => +c.textContent)])")
    assert {row[0] for row in rows} == {0, round(0.35 * len(tree))} and len(rows) == 2 * len(tree[0]["branches"])
    for phase, branch, length, mean, least, known, exists in rows:
        wanted = measure(tree[int(phase)]["branches"][int(branch)], 0)
        doubt = tree[int(phase)]["branches"][int(branch)]
        assert min(doubt["doubt_mm"]) - 0.01 <= known <= max(doubt["doubt_mm"]) + 0.01, (phase, branch, known)
        assert abs(exists - 100 * np.mean(doubt["existence"])) < 0.6, (phase, branch, exists)
        assert np.allclose([length, least, mean], wanted[:3], atol=0.051), (phase, branch, wanted)

    page.evaluate("document.getElementById('tree-lines').click()")
    assert page.evaluate("document.querySelectorAll('#tree-views polyline').length") == 0
