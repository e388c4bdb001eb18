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
    const complete = leverages(solver, asked.map(edge => [edge]), on, poses, (pull, left_out, columns) => {
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
    return complete ? found : null;
  };

  // For each unit of edges switched together, pass on what pulls at their nodes then, and their sigmas left out;
  // false where the edges that are on do not hold the map.
  function leverages(solver, units, on, poses, use) {
    const {matrix, edges: {source, target, covariance}} = solver, {size} = solver.group, {position} = matrix.pattern;
    solver.assemble(poses, on);
    if (!matrix.factorize()) return false;
    const wide = size * (size + 1) / 2, pool = [];
    for (const unit of units) {
      const rows = unit.length * size, spread = new Float64Array(rows * rows), right = new Float64Array(rows);
      while (pool.length < rows) pool.push(new Float64Array(solver.gradient.length));
      const columns = pool.slice(0, rows), sign = on[unit[0]] ? -1 : 1;
      unit.forEach((edge, n) => {
        const {before, after, off} = solver.jacobians(edge, poses), begin = n * size;
        right.set(off, begin);
        for (let r = 0; r < size; r++) {
          const column = columns[begin + r].fill(0);
          for (const [end, jacobian] of [[position[source[edge]], before], [position[target[edge]], after]]) {
            if (end >= 0) for (let k = 0; k < size; k++) column[end * size + k] += jacobian[r * size + k];
          }
          matrix.forward(column);
        }
        for (let r = 0, at = edge * wide; r < size; r++) {
          for (let c = r; c < size; c++) spread[(begin + r) * rows + begin + c] = covariance[at++];
        }
      });
      const places = met(columns);
      for (let r = 0; r < rows; r++) {
        const one = columns[r];
        for (let c = r; c < rows; c++) {
          const other = columns[c];
          let product = 0;
          for (const k of places) product += one[k] * other[k];
          spread[r * rows + c] += sign * product;
          spread[c * rows + r] = spread[r * rows + c];
        }
      }
      const pull = S.sparse.solved(spread, right.slice(), rows) || right.slice().fill(NaN);
      use(pull, Math.sqrt(Math.max(right.reduce((sum, one, k) => sum + one * pull[k], 0), 0)), columns);
    }
    return true;
  }

  // Where any of some columns is not zero: by the order of elimination in few places.
  function met(columns) {
    const places = [];
    for (let k = 0; k < columns[0].length; k++) {
      let n = 0;
      while (n < columns.length && columns[n][k] === 0) n++;
      if (n < columns.length) places.push(k);
    }
    return Int32Array.from(places);
  }

  // Loops whose ends both lie within `reach` keyframes of each other, or are chained so: a claim made many times.
  function stretches({source, target}, loops, reach) {
    const waiting = new Set(loops), found = [];
    for (const first of loops) {
      if (!waiting.delete(first)) continue;
      const unit = [first];
      for (const one of unit) {
        for (const other of waiting) {
          if (Math.abs(source[one] - source[other]) > reach || Math.abs(target[one] - target[other]) > reach) continue;
          waiting.delete(other);
          unit.push(other);
        }
      }
      found.push(unit);
    }
    return found;
  }

  // Switch off a loop that is on, or all those of one stretch, each time what the map without it is farthest off,
  // against its gate, as long as that is beyond it (data snooping: Baarda 1968). gates: squares, of one loop, of two and
  // so on. Gives those edges each time.
  S.snoop = function* (solver, loops, on, poses, {gates, reach}) {
    for (;;) {
      const held = loops.filter(edge => on[edge]), shares = [];
      const units = [...held.map(edge => [edge]), ...stretches(solver.edges, held, reach).filter(unit => unit.length > 1)];
      const use = (_, sigmas) => shares.push(sigmas * sigmas / gates[units[shares.length].length - 1]);
      if (!leverages(solver, units, on, poses, use)) return;
      const worst = shares.reduce((most, one, n) => one > (shares[most] ?? 1) ? n : most, -1);
      if (worst < 0) return;
      for (const edge of units[worst]) on[edge] = 0;
      ({poses} = solver.solve(on, poses));
      yield units[worst];
    }
  };
})(Scanweave);
