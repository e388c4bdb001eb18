// What each edge does to the map as it is solved now, to first order: see slam/graph/influence.py.
"use strict";
(S => {
  // Of edges `asked`, at the solution `poses` of the edges that are on: by how far a node moves at most if the edge is
  // switched, which node, and how many sigmas the map without the edge is off it (left_out); nothing is known (NaN)
  // where nothing else joins its nodes.
  S.influences = (solver, asked, on, poses) => {
    const {matrix, count} = solver, {size} = solver.group, {position} = matrix.pattern;
    const found = {edge: asked, shift_m: [], node: [], left_out: []};
    const moved = new Float64Array(solver.gradient.length);
    const told = leverages(solver, asked, on, poses, (pull, left_out, columns) => {
      moved.fill(0);
      columns.forEach((column, r) => {
        for (let at = 0; at < moved.length; at++) moved[at] += pull[r] * column[at];
      });
      matrix.backward(moved);
      let [most, farthest] = [0, 0];
      for (let node = 1; node < count; node++) {
        const at = position[node] * size + (size === 6 ? 3 : 0);
        const shift = Math.hypot(moved[at], moved[at + 1], size === 6 ? moved[at + 2] : 0);
        if (shift > most) [most, farthest] = [shift, node];
      }
      found.shift_m.push(most);
      found.node.push(farthest);
      found.left_out.push(left_out);
    });
    return told ? found : null;
  };

  // Tell of each edge what pulls at its nodes where it is switched, and its sigmas left out; false where the edges that
  // are on do not hold the map.
  function leverages(solver, asked, on, poses, tell) {
    const {matrix, edges: {source, target, covariance}} = solver, {size} = solver.group, {position} = matrix.pattern;
    solver.assemble(poses, on);
    if (!matrix.factorize()) return false;
    const wide = size * (size + 1) / 2, spread = new Float64Array(size * size);
    const columns = Array.from({length: size}, () => new Float64Array(solver.gradient.length));
    for (const edge of asked) {
      const {before, after, off} = solver.jacobians(edge, poses), sign = on[edge] ? -1 : 1;
      const ends = [[position[source[edge]], before], [position[target[edge]], after]].filter(([at]) => at >= 0);
      columns.forEach((column, r) => {
        column.fill(0);
        for (const [end, jacobian] of ends) for (let k = 0; k < size; k++) column[end * size + k] += jacobian[r * size + k];
        matrix.forward(column);
      });
      for (let r = 0, at = edge * wide; r < size; r++) {
        for (let c = r; c < size; c++) {
          let product = 0;
          for (let k = 0; k < columns[r].length; k++) product += columns[r][k] * columns[c][k];
          spread[r * size + c] = spread[c * size + r] = covariance[at++] + sign * product;
        }
      }
      const pull = S.sparse.solved(spread, Float64Array.from(off), size) || new Float64Array(size).fill(NaN);
      const square = off.reduce((sum, one, k) => sum + one * pull[k], 0);
      tell(pull, Math.sqrt(Math.max(square, 0)), columns);
    }
    return true;
  }

  // Switch off loops that are on, one after the other, each time the one that the map without it is farthest off, as
  // long as it is beyond the gate (data snooping: Baarda 1968). Gives each as {edge, poses}, with the map without it.
  S.snoop = function* (solver, loops, on, poses, gateSigmas) {
    for (;;) {
      const asked = loops.filter(edge => on[edge]), sigmas = [];
      if (!leverages(solver, asked, on, poses, (_, left_out) => sigmas.push(left_out))) return;
      const worst = sigmas.reduce((most, one, n) => one > (sigmas[most] ?? gateSigmas) ? n : most, -1);
      if (worst < 0) return;
      on[asked[worst]] = 0;
      ({poses} = solver.solve(on, poses));
      yield {edge: asked[worst], poses, sigmas: sigmas[worst]};
    }
  };
})(Scanweave);
