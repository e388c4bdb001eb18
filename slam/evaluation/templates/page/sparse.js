// Sparse Cholesky factors of symmetric matrices of small square blocks, in a given order of elimination.
"use strict";
(S => {
  // What the factor of a graph looks like, once for all its matrices.
  // order: numbers of the blocks as they are eliminated; sources, targets: blocks that meet in the matrix, or
  // others, that have no place in it.
  function symbolic(order, sources, targets) {
    const count = order.length, position = new Int32Array(order.reduce((most, node) => Math.max(most, node), 0) + 1).fill(-1);
    order.forEach((node, at) => { position[node] = at; });
    const below = Array.from({length: count}, () => new Set());
    for (let edge = 0; edge < sources.length; edge++) {
      const a = position[sources[edge]], b = position[targets[edge]];
      if (a >= 0 && b >= 0 && a !== b) below[Math.min(a, b)].add(Math.max(a, b));
    }
    // Columns one after the other: what is below one meets at the next below it.
    const first = new Int32Array(count + 1), columns = [];
    for (let column = 0; column < count; column++) {
      const rows = Int32Array.from(below[column]).sort();
      for (let at = 1; at < rows.length; at++) below[rows[0]].add(rows[at]);
      below[column] = null;
      columns.push(rows);
      first[column + 1] = first[column] + rows.length;
    }
    const rows = new Int32Array(first[count]);
    columns.forEach((ones, column) => rows.set(ones, first[column]));
    return {count, position, first, rows, updates: updatesOf(count, first, rows)};
  }

  // For each column, and each pair (i, j <= i) of the blocks below it: where block (i, j) is kept, -1 on the diagonal.
  function updatesOf(count, first, rows) {
    let total = 0;
    for (let column = 0; column < count; column++) {
      const size = first[column + 1] - first[column];
      total += size * (size + 1) / 2;
    }
    const updates = new Int32Array(total), slot = new Int32Array(count);
    for (let column = 0, at = 0; column < count; column++) {
      for (let j = first[column]; j < first[column + 1]; j++) {
        for (let k = first[rows[j]]; k < first[rows[j] + 1]; k++) slot[rows[k]] = k;
        updates[at++] = -1;
        for (let i = j + 1; i < first[column + 1]; i++) updates[at++] = slot[rows[i]];
      }
    }
    return updates;
  }

  // A matrix with the pattern of `symbolic`: blocks of size x size numbers, row by row, diagonal and below it.
  class BlockMatrix {
    constructor(pattern, size) {
      Object.assign(this, {pattern, size});
      this.diagonal = new Float64Array(pattern.count * size * size);
      this.lower = new Float64Array(pattern.rows.length * size * size);
    }

    clear() {
      this.diagonal.fill(0);
      this.lower.fill(0);
    }

    // Where block (row, column), positions of the elimination with row > column, begins in `lower`.
    at(row, column) {
      const {first, rows} = this.pattern;
      let low = first[column], high = first[column + 1] - 1;
      while (low < high) {
        const middle = (low + high) >> 1;
        if (rows[middle] < row) low = middle + 1; else high = middle;
      }
      return low * this.size * this.size;
    }

    // Replace the matrix by its Cholesky factor; false where it is not positive definite.
    factorize() {
      const {pattern: {count, first, rows, updates}, size, diagonal, lower} = this, area = size * size;
      let update = 0;
      for (let column = 0; column < count; column++) {
        if (!cholesky(diagonal, column * area, size)) return false;
        const end = first[column + 1];
        for (let k = first[column]; k < end; k++) divide(lower, k * area, diagonal, column * area, size);
        for (let j = first[column]; j < end; j++) {
          subtract(diagonal, rows[j] * area, lower, j * area, j * area, size);
          update++;
          for (let i = j + 1; i < end; i++) subtract(lower, updates[update++] * area, lower, i * area, j * area, size);
        }
      }
      return true;
    }

    // Solve for a right-hand side by the factor, in its place; (count, size) in the order of elimination.
    solve(x) {
      this.forward(x);
      this.backward(x);
    }

    // By the factor L alone. Where x is nothing it stays so: a right-hand side of few blocks costs little.
    forward(x) {
      const {pattern: {count, first, rows}, size, diagonal, lower} = this, area = size * size;
      for (let column = 0; column < count; column++) {
        const own = column * size;
        let nothing = true;
        for (let r = 0; r < size; r++) nothing &&= x[own + r] === 0;
        if (nothing) continue;
        for (let r = 0; r < size; r++) {
          let sum = x[own + r];
          for (let c = 0; c < r; c++) sum -= diagonal[column * area + r * size + c] * x[own + c];
          x[own + r] = sum / diagonal[column * area + r * size + r];
        }
        for (let k = first[column]; k < first[column + 1]; k++) {
          for (let r = 0; r < size; r++) {
            let sum = 0;
            for (let c = 0; c < size; c++) sum += lower[k * area + r * size + c] * x[own + c];
            x[rows[k] * size + r] -= sum;
          }
        }
      }
    }

    // By the factor's transpose.
    backward(x) {
      const {pattern: {count, first, rows}, size, diagonal, lower} = this, area = size * size;
      for (let column = count - 1; column >= 0; column--) {
        const own = column * size;
        for (let k = first[column]; k < first[column + 1]; k++) {
          for (let c = 0; c < size; c++) {
            let sum = 0;
            for (let r = 0; r < size; r++) sum += lower[k * area + r * size + c] * x[rows[k] * size + r];
            x[own + c] -= sum;
          }
        }
        for (let r = size - 1; r >= 0; r--) {
          let sum = x[own + r];
          for (let c = r + 1; c < size; c++) sum -= diagonal[column * area + c * size + r] * x[own + c];
          x[own + r] = sum / diagonal[column * area + r * size + r];
        }
      }
    }
  }

  // The factor of one block, in its place; what is above its diagonal is left.
  function cholesky(a, at, size) {
    for (let c = 0; c < size; c++) {
      for (let r = c; r < size; r++) {
        let sum = a[at + r * size + c];
        for (let k = 0; k < c; k++) sum -= a[at + r * size + k] * a[at + c * size + k];
        if (r > c) a[at + r * size + c] = sum / a[at + c * size + c];
        else if (sum > 0) a[at + c * size + c] = Math.sqrt(sum);
        else return false;
      }
    }
    return true;
  }

  // A block times the inverse of the transposed factor of another.
  function divide(a, at, factor, from, size) {
    for (let r = 0; r < size; r++) {
      for (let c = 0; c < size; c++) {
        let sum = a[at + r * size + c];
        for (let k = 0; k < c; k++) sum -= a[at + r * size + k] * factor[from + c * size + k];
        a[at + r * size + c] = sum / factor[from + c * size + c];
      }
    }
  }

  // A block less one block times another's transpose.
  function subtract(a, at, b, left, right, size) {
    for (let r = 0; r < size; r++) {
      for (let c = 0; c < size; c++) {
        let sum = 0;
        for (let k = 0; k < size; k++) sum += b[left + r * size + k] * b[right + c * size + k];
        a[at + r * size + c] -= sum;
      }
    }
  }

  // Solve one block's equations, both in their place; null where it is not positive definite.
  function solved(block, right, size) {
    if (!cholesky(block, 0, size)) return null;
    const alone = new BlockMatrix({count: 1, first: [0, 0], rows: []}, size);
    alone.diagonal = block;
    alone.solve(right);
    return right;
  }

  S.sparse = {symbolic, BlockMatrix, cholesky, solved};
})(Scanweave);
