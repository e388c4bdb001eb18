// The tab of what is selected: a loop, a step or a keyframe; both scans over each other, before and after.
"use strict";
(S => {
  const element = S.element, extensions = [];
  // Other parts add details of the selection: extend(chosen => element or null).
  S.details = {extend: details => extensions.push(details)};

  const facts = rows => element("dl", {class: "details"}, ...rows.filter(row => row && row[1] !== null).flatMap(
    ([what, value]) => [element("dt", {textContent: what}), element("dd", {}, value)]));

  const link = node => element("button", {
    type: "button", class: "link", textContent: S.keyframe(node), onclick: () => S.select.set({kind: "node", index: node, look: true}),
  });

  // How people and files name a keyframe: by its reading, and its session where there are several.
  S.keyframe = node => {
    const {readings, session} = S.data.nodes;
    return `${S.data.unit} ${readings[node]}${S.data.sessions.length > 1 ? ` of session ${session[node] + 1}` : ""}`;
  };

  // sqrt(r^T C^-1 r) of an edge in the plane: how far it is from the map, in its own sigmas.
  S.residual = (measured, triangle, source, target) => {
    const off = S.pose.between(measured, S.pose.between(S.pose.row(S.plan.poses, source), S.pose.row(S.plan.poses, target)));
    const [a, b, c, d, e, f] = triangle; // xx xy xt yy yt tt
    // Cholesky: C = L L^T; the whitened residual is L^-1 r.
    const l11 = Math.sqrt(a), l21 = b / l11, l31 = c / l11;
    const l22 = Math.sqrt(d - l21 * l21), l32 = (e - l31 * l21) / l22, l33 = Math.sqrt(f - l31 * l31 - l32 * l32);
    const u = off[0] / l11, v = (off[1] - l21 * u) / l22, w = (off[2] - l31 * u - l32 * v) / l33;
    return {off, sigmas: Math.hypot(u, v, w), sigma: [...S.way.axes(a, b, d).slice(0, 2), Math.sqrt(f)]};
  };

  // What was measured between two keyframes: {measured, triangle} of an edge, or of a loop that has a match.
  S.measured = chosen => {
    const {edges, loops} = S.data;
    const from = (table, at) => {
      const columns = table.measured.shape[1], wide = table.covariance.shape[1];
      return {
        measured: S.pose.row(table.measured, at, columns), columns,
        triangle: table.covariance.subarray(wide * at, wide * at + wide),
      };
    };
    if (chosen.kind === "edge") return from(edges, chosen.index);
    const at = loops.matched.indexOf(chosen.index);
    return at < 0 ? null : from(loops, at);
  };

  const length = metres => metres >= 1 ? `${metres.toFixed(1)} m` : `${(100 * metres).toFixed(1)} cm`;

  function describe(chosen) {
    const {edges, loops, planar} = S.data, [from, to] = S.ends(chosen);
    const match = S.measured(chosen);
    const rows = [["from", link(from)], ["to", link(to)], ["keyframes", `${from} and ${to}`]];
    if (chosen.kind === "loop") {
      const {index} = chosen;
      const reason = loops.reasons[loops.reason[index]];
      rows.push(["verdict", loops.accepted[index] ? "accepted" : `refused: ${reason}`]);
      rows.push(["matching points", Number.isFinite(loops.score[index]) ? `${(100 * loops.score[index]).toFixed(1)} %` : "no match"]);
      rows.push(["their residual", Number.isFinite(loops.residual_m[index]) ? `${(1000 * loops.residual_m[index]).toFixed(1)} mm` : null]);
      rows.push(["search window", `± ${S.number(loops.half_width_m[index], 2)} m`]);
    } else {
      rows.push(["kind", edges.kinds[edges.kind[chosen.index]]]);
      rows.push(["verdict", edges.kept[chosen.index] ? "kept" : "rejected by the final optimisation"]);
    }
    const along = Math.hypot(S.plan.poses[3 * from] - S.plan.poses[3 * to], S.plan.poses[3 * from + 1] - S.plan.poses[3 * to + 1]);
    rows.push(["distance in the map", `${along.toFixed(2)} m`]);
    if (match && planar) {
      const {off, sigmas, sigma} = S.residual(match.measured, match.triangle, from, to);
      rows.push(["map versus match", `${(100 * Math.hypot(off[0], off[1])).toFixed(1)} cm, ${(off[2] * 180 / Math.PI).toFixed(2)}°`]);
      rows.push(["in sigmas", sigmas.toFixed(1)]);
      rows.push(["sigma of the match", `${length(sigma[0])} × ${length(sigma[1])}, ${(sigma[2] * 180 / Math.PI).toFixed(2)}°`]);
    }
    return facts(rows);
  }

  function ofNode(node) {
    const {nodes, edges, loops, sessions} = S.data, [x, y, yaw] = S.pose.row(S.plan.poses, node);
    const ends = [...loops.place.keys()].filter(loop => loops.place[loop] === node || loops.keyframe[loop] === node);
    const steps = [...edges.loop.keys()].filter(
      edge => edges.loop[edge] < 0 && (edges.source[edge] === node || edges.target[edge] === node));
    const entry = (chosen, text) => element("li", {}, element("button", {
      type: "button", class: "link", textContent: text, onclick: () => S.select.set({...chosen, look: true}),
    }));
    return element("div", {}, facts([
      ["log", sessions[nodes.session[node]]],
      ["time", `${(nodes.stamps_s[node] - S.start()).toFixed(2)} s after the start`],
      ["place", `${x.toFixed(3)}, ${y.toFixed(3)} m; ${(yaw * 180 / Math.PI).toFixed(1)}°`],
      ["sigma of the position", Number.isFinite(nodes.sigmas_m[node]) ? `${(100 * nodes.sigmas_m[node]).toFixed(1)} cm` : null],
    ]), element("ul", {class: "plain"},
      ...ends.map(loop => entry({kind: "loop", index: loop}, `${loops.accepted[loop] ? "loop" : "refused loop"} ${
        S.keyframe(loops.place[loop])} – ${S.keyframe(loops.keyframe[loop])}`)),
      ...steps.map(edge => entry({kind: "edge", index: edge}, `${edges.kinds[edges.kind[edge]]}${edges.kept[edge] ? "" : " (refused)"} ${
        S.keyframe(edges.source[edge])} – ${S.keyframe(edges.target[edge])}`))));
  }

  // Small images of the keyframes at both ends.
  function pictures(chosen) {
    const {images} = S.data;
    if (!images) return null;
    const ends = S.ends(chosen), shown = [...images.node.keys()].filter(number => ends.includes(images.node[number]));
    return element("div", {class: "pictures-of"}, ...shown.map(number => {
      const address = S.image(number), name = `${images.cameras[images.camera[number]]}, ${S.keyframe(images.node[number])}`;
      return element("figure", {}, element("img", {src: address, alt: name, onload: () => URL.revokeObjectURL(address)}),
        element("figcaption", {textContent: name}));
    }));
  }

  S.ready(data => {
    if (!data.nodes) return;
    const panel = element("div");
    const fill = chosen => {
      if (!chosen) {
        panel.replaceChildren(element("p", {class: "soft", textContent: "Click a loop, an edge or a keyframe in the plan, or a row of the loop table."}));
        return;
      }
      const names = {node: "Keyframe", loop: "Loop", edge: "Step"};
      const [first] = S.ends(chosen);
      panel.replaceChildren(
        element("h3", {textContent: chosen.kind === "node" ? `Keyframe: ${S.keyframe(first)}` : names[chosen.kind]}),
        ...extensions.map(details => details(chosen)).filter(Boolean),
        S.overlay(chosen) || "",
        pictures(chosen) || "",
        chosen.kind === "node" ? ofNode(first) : describe(chosen),
      );
    };
    S.select.on(chosen => {
      fill(chosen);
      if (chosen) S.panels.show("details");
    });
    S.on("theme", () => fill(S.select.current));
    S.on("poses", () => fill(S.select.current));
    S.on("what-if", () => fill(S.select.current));
    fill(null);
    S.panels.add({name: "details", title: "Selected", element: panel, order: 20});
  }, 41);
})(Scanweave);
