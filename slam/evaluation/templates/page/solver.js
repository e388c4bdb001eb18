// The map solved again in the page: least squares over the edges that are on, node 0 held, as the final
// optimisation does it (slam/graph/pose_graph.py: Gaussian noise, no robust kernel, GTSAM's residuals).
"use strict";
(S => {
  const ROUNDS = 20, SETTLED = 1e-5, LEAST_DAMPING = 1e-4, GREATEST_DAMPING = 1e8;

  // The information matrices of covariances given as upper triangles, row by row.
  function informations(triangles, size) {
    const wide = size * (size + 1) / 2, count = triangles.length / wide, area = size * size;
    const out = new Float64Array(count * area), full = new Float64Array(area), column = new Float64Array(size);
    for (let edge = 0; edge < count; edge++) {
      for (let r = 0, at = edge * wide; r < size; r++) {
        for (let c = r; c < size; c++) full[r * size + c] = full[c * size + r] = triangles[at++];
      }
      for (let c = 0; c < size; c++) {
        column.fill(0);
        column[c] = 1;
        out.set(S.sparse.solved(full.slice(), column, size), edge * area + c * size);
      }
    }
    return out;
  }

  // Whether the edges that are on join every node to node 0; else a node that nothing holds.
  function looseNode(count, {source, target}, on) {
    const root = Int32Array.from({length: count}, (_, node) => node);
    const find = node => {
      while (root[node] !== node) node = root[node] = root[root[node]];
      return node;
    };
    for (let edge = 0; edge < source.length; edge++) if (on[edge]) root[find(source[edge])] = find(target[edge]);
    for (let node = 1; node < count; node++) if (find(node) !== find(0)) return node;
    return -1;
  }

  class Solver {
    // poses: (K, 3 or 7) rows of the nodes; edges: source, target, measured, covariance as in the page's data;
    // order: of elimination, all nodes.
    constructor({poses, edges, order, planar}) {
      this.group = planar ? S.lie.plane : S.lie.space;
      const {size} = this.group, columns = planar ? 3 : 7;
      this.count = poses.length / columns;
      this.edges = edges;
      this.start = this.read(poses);
      this.measured = Array.from({length: edges.source.length}, (_, edge) => this.group.read(edges.measured, edge));
      this.information = informations(edges.covariance, size);
      const free = Array.from(order).filter(node => node !== 0);
      this.matrix = new S.sparse.BlockMatrix(S.sparse.symbolic(free, edges.source, edges.target), size);
      this.gradient = new Float64Array(free.length * size);
      this.places = this.placesOf();
    }

    read(rows) {
      return Array.from({length: this.count}, (_, node) => this.group.read(rows, node));
    }

    rows(poses) {
      const rows = new Float64Array(this.count * (this.group.size === 3 ? 3 : 7));
      poses.forEach((pose, node) => this.group.write(pose, rows, node));
      return rows;
    }

    // Where the block of each edge's two nodes begins below the diagonal; -1 where one of them is held.
    placesOf() {
      const {edges: {source, target}, matrix} = this, {position} = matrix.pattern;
      return Int32Array.from(source, (_, edge) => {
        const a = position[source[edge]], b = position[target[edge]];
        return a < 0 || b < 0 ? -1 : matrix.at(Math.max(a, b), Math.min(a, b));
      });
    }

    residual(edge, poses) {
      const {source, target} = this.edges;
      const found = this.group.between(poses[source[edge]], poses[target[edge]]);
      return {found, off: this.group.log(this.group.between(this.measured[edge], found))};
    }

    // How the residual grows with a motion of either node.
    jacobians(edge, poses) {
      const {found, off} = this.residual(edge, poses), after = this.group.growth(off);
      const before = S.lie.product(after, this.group.adjoint(found), this.group.size);
      for (let at = 0; at < before.length; at++) before[at] = -before[at];
      return {before, after, off};
    }

    squared(edge, off) {
      const {size} = this.group, from = edge * size * size;
      let sum = 0;
      for (let r = 0; r < size; r++) {
        for (let c = 0; c < size; c++) sum += off[r] * this.information[from + r * size + c] * off[c];
      }
      return sum;
    }

    // Squared residuals of the edges that are on.
    cost(poses, on) {
      let sum = 0;
      for (let edge = 0; edge < on.length; edge++) if (on[edge]) sum += this.squared(edge, this.residual(edge, poses).off);
      return sum;
    }

    // How far the poses miss each edge, in its standard deviations.
    residuals(poses) {
      return Float64Array.from(this.measured, (_, edge) => Math.sqrt(this.squared(edge, this.residual(edge, poses).off)));
    }

    // Normal equations where the poses are.
    assemble(poses, on) {
      const {matrix, gradient, edges: {source, target}} = this, {position} = matrix.pattern;
      const {size} = this.group, area = size * size;
      matrix.clear();
      gradient.fill(0);
      for (let edge = 0; edge < on.length; edge++) {
        if (!on[edge]) continue;
        const {before, after, off} = this.jacobians(edge, poses);
        const weight = this.information.subarray(edge * area, (edge + 1) * area);
        const a = position[source[edge]], b = position[target[edge]];
        const weighted = [S.lie.product(weight, before, size), S.lie.product(weight, after, size)];
        if (a >= 0) this.gather(matrix.diagonal, a * area, before, weighted[0]);
        if (b >= 0) this.gather(matrix.diagonal, b * area, after, weighted[1]);
        if (this.places[edge] >= 0) {
          const [low, high] = a > b ? [before, weighted[1]] : [after, weighted[0]];
          this.gather(matrix.lower, this.places[edge], low, high);
        }
        for (let c = 0; c < size; c++) {
          for (let r = 0; r < size; r++) {
            if (a >= 0) gradient[a * size + c] -= weighted[0][r * size + c] * off[r];
            if (b >= 0) gradient[b * size + c] -= weighted[1][r * size + c] * off[r];
          }
        }
      }
    }

    // Add the transpose of one block times another.
    gather(into, at, left, right) {
      const {size} = this.group;
      for (let k = 0; k < size; k++) {
        for (let r = 0; r < size; r++) {
          const one = left[k * size + r];
          for (let c = 0; c < size; c++) into[at + r * size + c] += one * right[k * size + c];
        }
      }
    }

    moved(poses, step) {
      const {size} = this.group, {position} = this.matrix.pattern;
      return poses.map((pose, node) => position[node] < 0 ? pose
        : this.group.moved(pose, Array.from(step.subarray(position[node] * size, (position[node] + 1) * size))));
    }

    // Solve with the edges that are on (a flag each), from where the poses are; Gauss and Newton, damped where
    // that does not lower the cost (Marquardt 1963). loose: a node that nothing holds, or -1.
    solve(on, poses = this.start) {
      const began = performance.now(), {size} = this.group, loose = looseNode(this.count, this.edges, on);
      if (loose >= 0) return {loose, poses, rounds: 0, milliseconds: performance.now() - began};
      let cost = this.cost(poses, on), damping = 0, rounds = 0;
      for (let settled = false; !settled && rounds < ROUNDS && damping < GREATEST_DAMPING; rounds++) {
        this.assemble(poses, on);
        for (let at = 0; damping && at < this.matrix.diagonal.length; at += size * size) {
          for (let k = 0; k < size; k++) this.matrix.diagonal[at + k * (size + 1)] *= 1 + damping;
        }
        const step = this.gradient;
        if (this.matrix.factorize()) {
          this.matrix.solve(step);
          const next = this.moved(poses, step), better = this.cost(next, on);
          settled = step.every(one => Math.abs(one) < SETTLED);
          if (better <= cost || settled) {
            [poses, cost, damping] = [next, better, damping > LEAST_DAMPING ? damping / 10 : 0];
            continue;
          }
        }
        damping = Math.max(10 * damping, LEAST_DAMPING);
      }
      return {loose: -1, poses, cost, rounds, milliseconds: performance.now() - began};
    }

    // By how much each node lies elsewhere: metres.
    shifts(one, other) {
      return Float64Array.from(one, (pose, node) => this.group.apart(pose, other[node]));
    }
  }

  S.Solver = Solver;
})(Scanweave);
