"""Looks at stenoses in the viewer: a square marks each, and a click on its branch shows its numbers.

    python3 check_viewer_lesions.py URL TREE.json PICTURE.png   # made by tests/cli/stenosis.rs
"""
import json
import sys

from browser import Page

with open(sys.argv[2], encoding="utf-8") as file:
    tree = json.load(file)
phase = tree["phases"][0]
with Page(sys.argv[1] + "&tree=1") as page:
    page.wait("document.querySelectorAll('#tree polyline').length > 0 && !busy")
    squares = page.evaluate("document.querySelector('#tree .lesion').getAttribute('d').split('M').length - 1")
    assert squares == len(phase["lesions"]) > 0, (squares, len(phase["lesions"]))
    lesion = phase["lesions"][0]
    points = page.evaluate(f"document.querySelectorAll('#tree polyline')[{lesion['branch']}].getAttribute('points')").split()
    x, y = points[lesion["point"]].split(",")
    place = page.evaluate(f"(() => {{ const p = new DOMPoint({x}, {y}).matrixTransform("
                          "document.getElementById('tree').getScreenCTM()); return [p.x, p.y]; })()")
    page.click(*place)
    told = page.evaluate("document.getElementById('tree-text').textContent")
    print(told)
    assert told.startswith(f"Branch {lesion['branch']}:"), told
    source = {"images": "(diameters as the images show them)", "field": "(diameters as the field shows them)"}[tree["radii_from"]]
    assert source in told, (source, told)
    # The page rounds halves up, Python to even numbers.
    assert f"stenosis of {lesion['stenosis_percent']:.0f} %" in told or f"stenosis of {lesion['stenosis_percent'] + .01:.0f} %" in told, told
    assert f"{lesion['min_diameter_mm']:.2f} mm instead of {lesion['reference_diameter_mm']:.2f} mm" in told, told
    page.picture(sys.argv[3])
