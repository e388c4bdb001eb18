// Poses as Lie groups, with GTSAM's tangents: of the plane x, y, yaw; of space rotation vector, translation.
// A pose is an array: x, y, yaw; or nine numbers of a rotation, row by row, and a translation.
"use strict";
(S => {
  const wrapped = angle => Math.atan2(Math.sin(angle), Math.cos(angle));
  const SMALL = 1e-6, BERNOULLI = [1 / 12, -1 / 720, 1 / 30240, -1 / 1209600];

  // Solà, Deray and Atchuthan 2018, appendix A.
  const plane = {
    size: 3,
    read: (rows, at) => [rows[3 * at], rows[3 * at + 1], rows[3 * at + 2]],
    write: (pose, rows, at) => rows.set([pose[0], pose[1], wrapped(pose[2])], 3 * at),
    between(a, b) {
      const cos = Math.cos(a[2]), sin = Math.sin(a[2]), x = b[0] - a[0], y = b[1] - a[1];
      return [cos * x + sin * y, cos * y - sin * x, b[2] - a[2]];
    },
    log(pose) {
      const yaw = wrapped(pose[2]), half = 0.5 * yaw;
      const share = Math.abs(half) < SMALL ? 1 : half / Math.tan(half);
      return [share * pose[0] + half * pose[1], share * pose[1] - half * pose[0], yaw];
    },
    moved(pose, [u, v, turn]) {
      const along = Math.abs(turn) < SMALL ? 1 : Math.sin(turn) / turn;
      const aside = Math.abs(turn) < SMALL ? 0.5 * turn : (1 - Math.cos(turn)) / turn;
      const x = along * u - aside * v, y = aside * u + along * v;
      const cos = Math.cos(pose[2]), sin = Math.sin(pose[2]);
      return [pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y, pose[2] + turn];
    },
    // Of the inverse of a pose.
    adjoint([x, y, yaw]) {
      const cos = Math.cos(yaw), sin = Math.sin(yaw);
      return [cos, sin, x * sin - y * cos, -sin, cos, x * cos + y * sin, 0, 0, 1];
    },
    // How the logarithm grows with a small motion on the right.
    growth([u, v, turn]) {
      const half = 0.5 * turn, share = Math.abs(half) < SMALL ? 1 : half / Math.tan(half), area = turn * turn;
      const sine = Math.abs(turn) < SMALL ? turn / 6 : (turn - Math.sin(turn)) / area;
      const cosine = Math.abs(turn) < SMALL ? 0.5 : (1 - Math.cos(turn)) / area;
      const x = sine * u - cosine * v, y = sine * v + cosine * u;
      return [share, -half, half * y - share * x, half, share, -half * x - share * y, 0, 0, 1];
    },
    apart: (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]),
  };

  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const turned = (r, v) => [0, 3, 6].map(k => r[k] * v[0] + r[k + 1] * v[1] + r[k + 2] * v[2]);
  const back = (r, v) => [0, 1, 2].map(k => r[k] * v[0] + r[k + 3] * v[1] + r[k + 6] * v[2]);
  const hat = ([x, y, z]) => [0, -z, y, z, 0, -x, -y, x, 0];

  // Rotation vector of a rotation, by its quaternion: sure at half a turn, too.
  function vector(r) {
    const q = quaternion(r), length = Math.hypot(q[0], q[1], q[2]);
    const scale = length < SMALL ? 2 / q[3] : 2 * Math.atan2(length, q[3]) / length;
    return [scale * q[0], scale * q[1], scale * q[2]];
  }

  // x, y, z, w with w not negative (Shepperd 1978: from the greatest of the four).
  function quaternion(r) {
    const trace = r[0] + r[4] + r[8], greatest = Math.max(trace, r[0], r[4], r[8]);
    let q;
    if (greatest === trace) q = [r[7] - r[5], r[2] - r[6], r[3] - r[1], 1 + trace];
    else if (greatest === r[0]) q = [1 + 2 * r[0] - trace, r[1] + r[3], r[2] + r[6], r[7] - r[5]];
    else if (greatest === r[4]) q = [r[1] + r[3], 1 + 2 * r[4] - trace, r[5] + r[7], r[2] - r[6]];
    else q = [r[2] + r[6], r[5] + r[7], 1 + 2 * r[8] - trace, r[3] - r[1]];
    const scale = Math.sign(q[3] || 1) / Math.hypot(...q);
    return q.map(one => one * scale);
  }

  function rotation([x, y, z, w]) {
    return [
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ];
  }

  const space = {
    size: 6,
    read: (rows, at) => [...rotation(rows.subarray(7 * at + 3, 7 * at + 7)), ...rows.subarray(7 * at, 7 * at + 3)],
    write: (pose, rows, at) => rows.set([...pose.slice(9), ...quaternion(pose)], 7 * at),
    between(a, b) {
      const columns = [0, 1, 2].map(k => back(a, [b[k], b[k + 3], b[k + 6]]));
      const r = [0, 1, 2].flatMap(k => columns.map(column => column[k]));
      return [...r, ...back(a, [b[9] - a[9], b[10] - a[10], b[11] - a[11]])];
    },
    log(pose) {
      const w = vector(pose), t = pose.slice(9), angle = Math.hypot(...w);
      const once = cross(w, t), twice = cross(w, once), half = 0.5 * angle;
      const share = angle < SMALL ? 1 / 12 : (1 - half / Math.tan(half)) / (angle * angle);
      return [...w, ...t.map((one, k) => one - 0.5 * once[k] + share * twice[k])];
    },
    moved(pose, step) {
      const w = step.slice(0, 3), t = step.slice(3), angle = Math.hypot(...w), half = 0.5 * angle;
      const sine = angle < SMALL ? 0.5 : Math.sin(half) / angle;
      const turn = rotation([...w.map(one => one * sine), Math.cos(half)]);
      const first = angle < SMALL ? 0.5 : (1 - Math.cos(angle)) / (angle * angle);
      const second = angle < SMALL ? 1 / 6 : (angle - Math.sin(angle)) / angle ** 3;
      const once = cross(w, t), twice = cross(w, once);
      const way = turned(pose, t.map((one, k) => one + first * once[k] + second * twice[k]));
      const columns = [0, 1, 2].map(k => turned(pose, [turn[k], turn[k + 3], turn[k + 6]]));
      return [...[0, 1, 2].flatMap(k => columns.map(column => column[k])), ...way.map((one, k) => one + pose[9 + k])];
    },
    adjoint(pose) {
      const inverse = [0, 1, 2].flatMap(k => [pose[k], pose[k + 3], pose[k + 6]]);
      const moment = product(hat(turned(inverse, pose.slice(9)).map(one => -one)), inverse, 3);
      return blocks(inverse, [0, 0, 0, 0, 0, 0, 0, 0, 0], moment, inverse);
    },
    // By the series of Bernoulli's numbers.
    growth(tangent) {
      const none = [0, 0, 0, 0, 0, 0, 0, 0, 0], turn = hat(tangent);
      const small = blocks(turn, none, hat(tangent.slice(3)), turn), square = product(small, small, 6);
      const out = small.map((one, at) => 0.5 * one + (at % 7 === 0));
      let power = square;
      for (const share of BERNOULLI) {
        power.forEach((one, at) => { out[at] += share * one; });
        power = product(power, square, 6);
      }
      return out;
    },
    apart: (a, b) => Math.hypot(a[9] - b[9], a[10] - b[10], a[11] - b[11]),
  };

  const blocks = (a, b, c, d) => [[a, b], [c, d]].flatMap(([left, right]) => [0, 3, 6].flatMap(
    k => [...left.slice(k, k + 3), ...right.slice(k, k + 3)]));

  function product(a, b, size) {
    const out = new Array(size * size).fill(0);
    for (let r = 0; r < size; r++) for (let k = 0; k < size; k++) {
      const one = a[r * size + k];
      if (one) for (let c = 0; c < size; c++) out[r * size + c] += one * b[k * size + c];
    }
    return out;
  }

  S.lie = {plane, space, product};
})(Scanweave);
