// The tree on a run's page: every training view with the lines at the phase of its picture; phase and branch are chosen for all
// views.
(() => {
  const $ = id => document.getElementById(id), SVG = "http://www.w3.org/2000/svg", REACH_PX = 12;
  const {tree, views} = JSON.parse($("tree-data").textContent), phases = tree.phases.length;
  const between = (a, b) => Math.min((a - b + phases) % phases, (b - a + phases) % phases);
  let place = null;

  const figures = views.map(view => {
    const figure = document.createElement("figure"), svg = document.createElementNS(SVG, "svg");
    const image = document.createElementNS(SVG, "image"), caption = document.createElement("figcaption");
    svg.setAttribute("viewBox", `-0.5 -0.5 ${view.width} ${view.height}`);
    for (const [name, value] of Object.entries({x: -0.5, y: -0.5, width: view.width, height: view.height})) image.setAttribute(name, value);
    svg.append(image); figure.append(svg, caption); $("tree-views").append(figure);
    const overlay = new trees.Overlay(svg);
    svg.addEventListener("click", e => {
      const found = overlay.pick(e.clientX, e.clientY, REACH_PX);
      choose(found && {...found, phase: shown(view).phase, view});
    });
    return {view, image, caption, overlay};
  });

  // Returns the picture of a view whose phase is nearest to the chosen one.
  function shown(view) {
    const phase = Number($("tree-phase").value);
    return view.frames.reduce((best, frame) => between(frame.phase, phase) < between(best.phase, phase) ? frame : best);
  }
  function choose(found) { place = found; draw(); }
  // In a tree that is not tracked, a branch number means another branch at another phase.
  const placeAt = phase => place && (tree.tracked || place.phase === phase) ? place : null;
  function draw() {
    $("tree-phase-text").textContent = $("tree-phase").value;
    for (const {view, image, caption, overlay} of figures) {
      const frame = shown(view);
      image.setAttribute("href", frame.picture);
      caption.textContent = `${view.title}, phase ${frame.phase}`;
      const branches = trees.branchesAt(tree, frame.phase);
      if ($("tree-lines").checked) {
        overlay.draw(branches, frame.projection, placeAt(frame.phase));
        overlay.drawLesions(trees.lesionsAt(tree, frame.phase), branches, frame.projection);
      } else overlay.clear();
      overlay.drawDoubt($("tree-doubt")?.checked ? branches : [], frame.projection);
    }
    if ($("tree-legend")) $("tree-legend").hidden = !$("tree-doubt").checked;
    const phase = place ? shown(place.view).phase : 0;
    const here = placeAt(phase);
    $("tree-told").textContent = here ? `${trees.branchText(tree, trees.branchesAt(tree, phase), here, trees.lesionsAt(tree, phase))} (phase ${phase}).` : "Click a line.";
    for (const row of document.querySelectorAll("tr[data-branch]")) {
      const of = placeAt(Number(row.dataset.phase));
      row.classList.toggle("chosen", of !== null && of.branch === Number(row.dataset.branch));
    }
  }
  for (const mark of document.querySelectorAll("[data-colour]")) mark.style.background = trees.colour(Number(mark.dataset.colour));
  if ($("tree-legend")) trees.legend($("tree-legend"));
  $("tree-phase").max = phases - 1;
  for (const id of ["tree-phase", "tree-lines", "tree-doubt"]) $(id)?.addEventListener("input", draw);
  draw();
})();
