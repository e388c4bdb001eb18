// The tab "What if": loops and steps switched off and on, the map solved again and shown so, and what was decided.
"use strict";
(S => {
  const element = S.element;
  // How many doubtful loops are listed; how long the map is drawn before more is computed.
  const LISTED = 12, AFTER_MS = 50;

  // The graph's edges, and after them the matched loop candidates that never came into it, in order; see
  // slam/evaluation/page_data.py. loop: number of the candidate, -1 for steps.
  function allEdges({edges, loops}) {
    const rows = [...loops.matched.keys()].filter(at => loops.edge[loops.matched[at]] < 0);
    const wide = edges.covariance.shape[1], columns = edges.measured.shape[1];
    const joined = (Kind, inside, outside) => {
      const all = new Kind(inside.length + outside.length);
      all.set(inside);
      all.set(outside, inside.length);
      return all;
    };
    const taken = (array, width) => rows.flatMap(at => Array.from(array.subarray(width * at, width * at + width)));
    const numbers = rows.map(at => loops.matched[at]);
    return {
      source: joined(Int32Array, edges.source, numbers.map(loop => loops.place[loop])),
      target: joined(Int32Array, edges.target, numbers.map(loop => loops.keyframe[loop])),
      measured: joined(Float64Array, edges.measured, taken(loops.measured, columns)),
      covariance: joined(Float64Array, edges.covariance, taken(loops.covariance, wide)),
      loop: joined(Int32Array, edges.loop, numbers),
      kept: joined(Uint8Array, edges.kept, numbers.map(() => 0)),
    };
  }

  const whatIf = S.whatIf = {
    edges: null, on: null, solver: null, base: null,
    // The map as it is shown: solution, how far each node lies from the map; null while nothing is switched.
    found: null, shifts: null,
    // Of loops, by the map as it is shown: {edge, shift_m, node, left_out}; null until it is computed.
    influence: null, waits: 0,

    // The edges that are switched, by their numbers.
    switched: () => [...whatIf.edges.kept.keys()].filter(edge => whatIf.on[edge] !== whatIf.edges.kept[edge]),

    // The number of the edge of what is selected, -1 where it has none.
    edgeOf: chosen => {
      if (!chosen || chosen.kind === "node") return -1;
      return chosen.kind === "edge" ? chosen.index : whatIf.edges.loop.indexOf(chosen.index);
    },

    start() {
      if (whatIf.solver) return;
      const {nodes, order, planar} = S.data;
      whatIf.solver = new S.Solver({poses: nodes.poses, edges: whatIf.edges, order, planar});
      // The optimisation stops a little before the very solution; shifts are relative to its result.
      whatIf.base = whatIf.solver.solve(whatIf.edges.kept).poses;
    },

    toggle(edge) {
      whatIf.on[edge] ^= 1;
      whatIf.update();
    },

    reset() {
      whatIf.on.set(whatIf.edges.kept);
      whatIf.update();
    },

    // Solve, show, and write down what was decided.
    update() {
      whatIf.start();
      const changed = whatIf.switched(), {solver, base, on} = whatIf;
      whatIf.found = changed.length ? solver.solve(on, base) : null;
      whatIf.shifts = whatIf.found && whatIf.found.loose < 0 ? solver.shifts(base, whatIf.found.poses) : null;
      whatIf.influence = changed.length ? null : S.data.influence;
      decide(changed);
      S.plan.highlight(changed.filter(edge => edge < S.data.edges.source.length));
      S.plan.showPoses(whatIf.shifts ? solver.rows(whatIf.found.poses) : null);
      S.emit("what-if");
      clearTimeout(whatIf.waits);
      if (whatIf.shifts) whatIf.waits = setTimeout(whatIf.tell, AFTER_MS);
    },

    // Influence of all loops on the map as it is shown: it takes longer than the map.
    tell() {
      whatIf.influence = S.influences(whatIf.solver, whatIf.loops(), whatIf.on, whatIf.found.poses);
      S.emit("what-if");
    },

    loops: () => [...whatIf.edges.loop.keys()].filter(edge => whatIf.edges.loop[edge] >= 0),

    // Switch off doubtful loops one after the other; the map is shown after each.
    async snoop() {
      whatIf.start();
      const start = whatIf.shifts ? whatIf.found.poses : whatIf.base;
      for (const _ of S.snoop(whatIf.solver, whatIf.loops(), whatIf.on, start, S.data.influence)) {
        whatIf.update();
        await new Promise(resolve => setTimeout(resolve));
      }
    },
  };

  // A keyframe as edits.yaml names it.
  const named = node => ({session: S.data.nodes.session[node] + 1, reading: S.data.nodes.readings[node]});

  // Loops that are switched go into the edits; steps cannot be edited.
  function decide(changed) {
    const {edges, on} = whatIf, lists = {forbid: [], force: []};
    for (const edge of changed.filter(one => edges.loop[one] >= 0)) {
      lists[on[edge] ? "force" : "forbid"].push([named(edges.source[edge]), named(edges.target[edge])]);
    }
    S.edits.loops = {...S.edits.loops, ...lists};
    for (const name of ["forbid", "force"]) if (!S.edits.loops[name].length) delete S.edits.loops[name];
    if (!Object.keys(S.edits.loops).length) delete S.edits.loops;
    S.emit("edits");
  }

  const length = metres => metres < 0.0995 ? `${(100 * metres).toFixed(metres < 0.00995 ? 2 : 1)} cm` : `${metres.toFixed(2)} m`;
  const nodeLink = (text, node) => element("button", {
    type: "button", class: "link", textContent: text, onclick: () => {
      S.select.set({kind: "node", index: node});
      S.plan.look([[S.plan.poses[3 * node], S.plan.poses[3 * node + 1]]]);
    },
  });
  const chosenOf = edge => whatIf.edges.loop[edge] >= 0 ? {kind: "loop", index: whatIf.edges.loop[edge]} : {kind: "edge", index: edge};
  const edgeLink = edge => element("button", {
    type: "button", class: "link", onclick: () => S.select.set({...chosenOf(edge), look: true}),
    textContent: `${whatIf.edges.loop[edge] >= 0 ? "" : "step "}${S.keyframe(whatIf.edges.source[edge])} – ${S.keyframe(whatIf.edges.target[edge])}`,
  });
  const toggleButton = (edge, text) => element("button", {
    type: "button", class: "switch", textContent: text, onclick: () => whatIf.toggle(edge),
  });
  const verdict = edge => {
    const {edges, on} = whatIf, back = on[edge] !== edges.kept[edge];
    return on[edge] ? (back ? "Remove it again" : "Switch it off") : (back ? "Switch it on again" : "Force it on");
  };

  // What the switches did.
  function outcome() {
    const {found, shifts, solver} = whatIf;
    if (!found) return element("p", {class: "soft", textContent: "Switch loops or edges off, or rejected loops on: the map is solved again at once."});
    if (!shifts) {
      return element("p", {}, "Nothing else connects the map: ", nodeLink(S.keyframe(found.loose), found.loose), " would be disconnected.");
    }
    const most = shifts.reduce((best, shift, node) => shift > shifts[best] ? node : best, 0);
    const missed = solver.residuals(found.poses).reduce((sum, one, edge) => sum + (whatIf.on[edge] ? one * one : 0), 0);
    return element("div", {}, element("p", {id: "moved"}, `The map moved by at most ${length(shifts[most])}, `, nodeLink("here", most), "."),
      element("p", {class: "soft", textContent: `Squared residuals ${missed.toFixed(0)}; solved in ${found.milliseconds.toFixed(0)} ms.`}));
  }

  // One line of a loop's influence.
  function influenceOf(edge) {
    const effect = whatIf.influence, at = effect ? effect.edge.indexOf(edge) : -1;
    if (at < 0) return null;
    if (!Number.isFinite(effect.shift_m[at])) return element("p", {textContent: "Nothing else connects the map there."});
    const verb = whatIf.on[edge] ? "Without it the map moves" : "With it the map would move";
    return element("p", {}, `${verb} ${length(effect.shift_m[at])}, `, nodeLink("here", effect.node[at]),
      `; the rest of the map is ${effect.left_out[at].toFixed(1)} sigmas away from it.`);
  }

  // What is doubtful first, of the loops that are on.
  function doubtful() {
    const effect = whatIf.influence;
    if (!effect) return null;
    const gate = Math.sqrt(S.data.influence.gates[0]);
    const rows = [...effect.edge.keys()].filter(at => whatIf.on[effect.edge[at]] && effect.left_out[at] > gate)
      .sort((a, b) => effect.left_out[b] - effect.left_out[a]);
    const head = element("h3", {textContent: `Doubtful loops: ${rows.length}`});
    if (!rows.length) return element("div", {}, head, element("p", {class: "soft", textContent: `No loop is more than ${gate.toFixed(1)} sigmas away from the rest of the map.`}));
    return element("div", {}, head, element("ul", {class: "plain"}, ...rows.slice(0, LISTED).map(at => element("li", {},
      toggleButton(effect.edge[at], "off"), " ", edgeLink(effect.edge[at]), ` ${effect.left_out[at].toFixed(1)} σ, ${length(effect.shift_m[at])}`))),
      element("button", {type: "button", id: "snoop", textContent: "Switch off the worst one until none is left", onclick: whatIf.snoop}));
  }

  function columns() {
    const value = name => loop => {
      const effect = whatIf.influence, at = effect ? effect.edge.indexOf(whatIf.edges.loop.indexOf(loop)) : -1;
      return at < 0 ? NaN : effect[name][at];
    };
    const cached = name => {
      let cache = new Map();
      S.on("what-if", () => { cache = new Map(); });
      return loop => cache.has(loop) ? cache.get(loop) : cache.set(loop, value(name)(loop)).get(loop);
    };
    const shift = cached("shift_m"), off = cached("left_out");
    S.loops.add({name: "shift", title: "moves", value: shift, text: loop => Number.isFinite(shift(loop)) ? length(shift(loop)) : "–"});
    S.loops.add({name: "left-out", title: "removed", value: off, text: loop => S.number(off(loop), 1)});
  }

  S.ready(data => {
    if (!data.nodes || !data.influence) return;
    whatIf.edges = allEdges(data);
    whatIf.on = whatIf.edges.kept.slice();
    whatIf.influence = data.influence;
    columns();
    const panel = element("div");
    const fill = () => {
      const changed = whatIf.switched();
      panel.replaceChildren(outcome(), ...(changed.length ? [
        element("h3", {textContent: `Switched: ${changed.length}`}),
        element("ul", {class: "plain"}, ...changed.map(edge => element("li", {},
          toggleButton(edge, whatIf.on[edge] ? "off" : "on"), " ", edgeLink(edge)))),
        element("div", {class: "choice"},
          element("button", {type: "button", id: "what-if-reset", textContent: "Back to the map", onclick: whatIf.reset}),
          element("button", {type: "button", id: "edits-download", textContent: "Save edits.yaml", onclick: () => S.editing.download()})),
        changed.some(edge => whatIf.edges.loop[edge] < 0) ? element("p", {class: "soft", textContent: "Changes to odometry edges are not saved; edits.yaml contains loops only."}) : "",
      ] : []), doubtful() || "");
    };
    S.on("what-if", fill);
    S.on("what-if", () => S.emit("loops"));
    S.details.extend(chosen => {
      const edge = whatIf.edgeOf(chosen);
      return edge < 0 ? null : element("div", {class: "what-if"}, influenceOf(edge) || "", toggleButton(edge, verdict(edge)));
    });
    fill();
    S.panels.add({name: "what-if", title: "What if", element: panel, order: 35});
    S.key("x", "switch the selected loop or step off or on", () => {
      const edge = whatIf.edgeOf(S.select.current);
      if (edge >= 0) whatIf.toggle(edge);
    });
    S.on("ready", () => setTimeout(whatIf.start));
  }, 45);
})(Scanweave);
