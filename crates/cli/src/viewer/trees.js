// Vessel trees over pictures: projection of points, lines, selection by click, and text about the selected branch. The viewer
// and the report share this script. Points are in patient mm (left, posterior, superior); places in pictures are columns and
// rows, with pixel centres at integers.
"use strict";
const trees = (() => {
  // Colours that can be distinguished on white, on grey and on black.
  const COLOURS = ["#e6194b", "#1f8fff", "#2ca02c", "#ff8c00", "#b14bff", "#00a5a5", "#e75cc4", "#9a7b00"];
  const SVG = "http://www.w3.org/2000/svg";
  const MARK_PX = 5, LESION_PX = 9;
  // Upper bounds of the levels of doubt, mm (the last level has none), and their colours, from certain to doubtful.
  const DOUBT_MM = [0.25, 0.5, 1, 2, 4, Infinity];
  const DOUBT_COLOURS = ["#0b7a3b", "#3fae49", "#b3b300", "#f08c00", "#e0481f", "#9c0026"];
  const mix = (a, b, share) => a + (b - a) * share;
  const colour = branch => COLOURS[branch % COLOURS.length];

  // Returns the projection of a C-arm onto a picture of `side` x `side` pixels, like `CArm::rays` of crates/angiograms/src/geometry.rs.
  function cArmProjection(cArm, primary, secondary, side) {
    const [a, b] = [primary, secondary].map(degrees => degrees * Math.PI / 180);
    const columns = [Math.cos(a), Math.sin(a), 0];
    const rows = [Math.sin(a) * Math.sin(b), -Math.cos(a) * Math.sin(b), -Math.cos(b)];
    const beam = [Math.sin(a) * Math.cos(b), -Math.cos(a) * Math.cos(b), Math.sin(b)];
    const pixel = cArm.extent_mm / side, focal = cArm.sid_mm / pixel;
    const row = (across, axis) => {
      const centre = side / 2 - 0.5 - cArm.offset_mm[axis] / pixel;
      return [...across.map((v, i) => focal * v + centre * beam[i]), centre * cArm.sod_mm];
    };
    return [row(columns, 0), row(rows, 1), [...beam, cArm.sod_mm]];
  }

  // Returns column and row of a point; null behind the source.
  function project(projection, point) {
    const [u, v, depth] = projection.map(r => r[0] * point[0] + r[1] * point[1] + r[2] * point[2] + r[3]);
    return depth > 0 ? [u / depth, v / depth] : null;
  }

  // Returns the branches at a phase. For a tracked tree, points between two phases are interpolated linearly, and the beat is
  // periodic; for other trees, the branches are those of the nearest phase.
  function branchesAt(tree, phase) {
    const n = tree.phases.length, before = Math.floor(phase), share = phase - before;
    if (!tree.tracked || share === 0) return tree.phases[Math.round(phase) % n].branches;
    const next = tree.phases[(before + 1) % n].branches;
    return tree.phases[before % n].branches.map((branch, b) => ({
      points_mm: branch.points_mm.map((p, i) => p.map((v, axis) => mix(v, next[b].points_mm[i][axis], share))),
      radius_mm: branch.radius_mm.map((r, i) => mix(r, next[b].radius_mm[i], share)),
      doubt_mm: branch.doubt_mm, doubt_direction: branch.doubt_direction, existence: branch.existence, gap_mm: branch.gap_mm,
    }));
  }

  // Returns the arc length along a line at each of its points, mm.
  function ways(points) {
    let way = 0;
    return points.map((p, i) => way += i ? Math.hypot(...p.map((v, axis) => v - points[i - 1][axis])) : 0);
  }

  // Returns length and diameters of a branch, mm, and the diameter at a place: `share` of the way from point `from` to the
  // next.
  function measure(branch, {from, share}) {
    const along = ways(branch.points_mm), wide = branch.radius_mm.map(r => 2 * r), length = along[along.length - 1];
    const sum = wide.slice(1).reduce((sum, d, i) => sum + (d + wide[i]) / 2 * (along[i + 1] - along[i]), 0);
    return {
      length_mm: length, least_mm: Math.min(...wide), mean_mm: length > 0 ? sum / length : wide[0],
      here_mm: mix(wide[from], wide[from + 1], share), along_mm: mix(along[from], along[from + 1], share),
    };
  }

  // Returns the stenoses at a phase; those of the nearest phase between two.
  function lesionsAt(tree, phase) {
    return tree.phases[Math.round(phase) % tree.phases.length].lesions;
  }

  // Returns the text about the stenoses of a branch.
  function lesionsText(branch, lesions) {
    const along = ways(branch.points_mm);
    return lesions.map(lesion => `; stenosis of ${lesion.stenosis_percent.toFixed(0)} %, ${along[lesion.point].toFixed(1)} mm from its start: `
      + `${lesion.min_diameter_mm.toFixed(2)} mm instead of ${lesion.reference_diameter_mm.toFixed(2)} mm`).join("");
  }

  // Returns the text about a clicked branch of a tree.
  function branchText(tree, branches, place, lesions) {
    const m = measure(branches[place.branch], place), mm = v => v.toFixed(2) + " mm";
    return `Branch ${place.branch}: ${m.length_mm.toFixed(1)} mm long; minimum diameter ${mm(m.least_mm)}, `
      + `mean ${mm(m.mean_mm)}, ${mm(m.here_mm)} at this point, ${m.along_mm.toFixed(1)} mm from its start `
      + (tree.radii_from === "images" ? "(diameters as the images show them)" : "(diameters as the field shows them)")
      + gapText(branches[place.branch])
      + doubtText(branches[place.branch], place)
      + lesionsText(branches[place.branch], lesions.filter(lesion => lesion.branch === place.branch));
  }

  // Returns the text about the gaps in a branch; nothing where there are none.
  function gapText({gap_mm}) {
    return gap_mm ? `; the field shows nothing over ${gap_mm.toFixed(1)} mm of it, where two vessels are linked because one points at the other` : "";
  }

  // Returns the text about the doubt at a place; nothing where doubt is not stated.
  function doubtText({doubt_mm, existence}, {from, share}) {
    if (!doubt_mm) return "";
    const here = values => mix(values[from], values[from + 1], share);
    return `; known to ${here(doubt_mm).toFixed(2)} mm (68 %), exists with ${(100 * here(existence)).toFixed(0)} %`;
  }

  // Draws lines over one picture, in an SVG element whose units are the picture's pixels.
  class Overlay {
    constructor(svg) {
      this.svg = svg; this.lines = []; this.seen = []; this.branches = [];
      this.mark = svg.appendChild(document.createElementNS(SVG, "circle"));
      this.mark.setAttribute("class", "mark");
      this.intervals = svg.insertBefore(document.createElementNS(SVG, "path"), this.mark);
      this.intervals.setAttribute("class", "interval");
      this.intervals.setAttribute("vector-effect", "non-scaling-stroke");
      this.lesions = this.svg.insertBefore(document.createElementNS(SVG, "path"), this.mark);
      this.lesions.setAttribute("class", "lesion");
      this.lesions.setAttribute("vector-effect", "non-scaling-stroke");
      this.levels = DOUBT_COLOURS.map(colour => {
        const level = this.svg.insertBefore(document.createElementNS(SVG, "path"), this.mark);
        level.setAttribute("class", "level");
        level.setAttribute("vector-effect", "non-scaling-stroke");
        level.style.stroke = colour;
        return level;
      });
    }
    // Draws a square around the narrowest place of each stenosis.
    drawLesions(lesions, branches, projection) {
      const half = branches.length ? LESION_PX / this.svg.getScreenCTM().a : 0;
      const square = ({branch, point}) => {
        const at = project(projection, branches[branch].points_mm[point]);
        return at ? `M${(at[0] - half).toFixed(2)} ${(at[1] - half).toFixed(2)}h${2 * half}v${2 * half}h${-2 * half}z` : "";
      };
      this.lesions.setAttribute("d", branches.length ? lesions.map(square).join("") : "");
    }
    // Draws the intervals of all points, each as a line along its least certain direction, and the centrelines in the colours of the
    // doubt about their points; nothing without branches.
    drawDoubt(branches, projection) {
      const coloured = DOUBT_MM.map(() => "");
      for (const {doubt_mm, points_mm} of branches.filter(branch => branch.doubt_mm)) {
        points_mm.slice(1).forEach((point, i) => {
          const ends = [points_mm[i], point].map(end => project(projection, end));
          const level = DOUBT_MM.findIndex(bound => (doubt_mm[i] + doubt_mm[i + 1]) / 2 <= bound);
          if (ends.every(Boolean)) coloured[level] += "M" + ends.map(p => p.map(v => v.toFixed(2)).join(" ")).join("L");
        });
      }
      this.levels.forEach((level, i) => level.setAttribute("d", coloured[i]));
      const strokes = branches.filter(branch => branch.doubt_mm).flatMap(branch => branch.points_mm.map((point, i) => {
        const end = sign => point.map((v, axis) => v + sign * branch.doubt_mm[i] * branch.doubt_direction[i][axis]);
        const ends = [-1, 1].map(sign => project(projection, end(sign)));
        return ends.every(Boolean) ? "M" + ends.map(p => p.map(v => v.toFixed(2)).join(" ")).join("L") : "";
      }));
      this.intervals.setAttribute("d", strokes.join(""));
    }
    clear() { this.draw([], null, null); this.drawLesions([], [], null); }
    draw(branches, projection, place) {
      this.branches = branches;
      this.seen = branches.map(branch => branch.points_mm.map(point => project(projection, point)));
      while (this.lines.length > branches.length) this.lines.pop().remove();
      while (this.lines.length < branches.length) {
        const line = document.createElementNS(SVG, "polyline");
        line.style.stroke = colour(this.lines.length);
        this.lines.push(this.svg.insertBefore(line, this.intervals));
      }
      this.seen.forEach((points, b) => {
        this.lines[b].setAttribute("points", points.filter(Boolean).map(p => p.map(v => v.toFixed(3)).join()).join(" "));
        this.lines[b].classList.toggle("chosen", place !== null && place.branch === b);
      });
      const line = place && this.seen[place.branch], [from, to] = line ? [line[place.from], line[place.from + 1]] : [];
      this.mark.setAttribute("r", from && to ? MARK_PX / this.svg.getScreenCTM().a : 0);
      if (from && to) ["cx", "cy"].forEach((name, i) => this.mark.setAttribute(name, mix(from[i], to[i], place.share)));
    }
    // Returns the place on a line that is nearest to the pointer on the screen; null if none is within `reach` pixels of the
    // screen.
    pick(clientX, clientY, reach) {
      const screen = this.svg.getScreenCTM();
      const at = new DOMPoint(clientX, clientY).matrixTransform(screen.inverse());
      let nearest = null, best = reach / screen.a;
      this.seen.forEach((points, branch) => points.slice(1).forEach((to, from) => {
        const begin = points[from];
        if (!begin || !to) return;
        const way = [to[0] - begin[0], to[1] - begin[1]], length2 = way[0] ** 2 + way[1] ** 2;
        const along = ((at.x - begin[0]) * way[0] + (at.y - begin[1]) * way[1]) / (length2 || 1);
        const share = Math.max(0, Math.min(1, along));
        const away = Math.hypot(begin[0] + share * way[0] - at.x, begin[1] + share * way[1] - at.y);
        if (away < best) [best, nearest] = [away, {branch, from, share}];
      }));
      return nearest;
    }
  }
  // Fills an element with the meaning of the colours of doubt.
  function legend(element) {
    const texts = DOUBT_MM.map((bound, i) => Number.isFinite(bound) ? `to ${bound} mm` : `above ${DOUBT_MM[i - 1]} mm`);
    element.replaceChildren("Known (68 %): ", ...texts.flatMap((text, i) => {
      const entry = document.createElement("span"), mark = document.createElement("span");
      entry.style.cssText = "white-space:nowrap";
      mark.style.cssText = `display:inline-block;width:.8em;height:.8em;background:${DOUBT_COLOURS[i]}`;
      entry.append(mark, ` ${text}`);
      return [entry, "  "];
    }));
  }
  return {Overlay, branchesAt, cArmProjection, colour, legend, lesionsAt, branchText};
})();
