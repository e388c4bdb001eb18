// Poses in the plane as rows x, y, yaw of flat arrays.
"use strict";
(S => {
  const wrapped = angle => Math.atan2(Math.sin(angle), Math.cos(angle));

  // x, y, yaw of row `at` of an array of 3 columns, or of 7 (x, y, z, quaternion x, y, z, w).
  const row = (poses, at, columns = 3) => {
    if (columns === 3) return [poses[3 * at], poses[3 * at + 1], poses[3 * at + 2]];
    const [x, y, , qx, qy, qz, qw] = poses.subarray(7 * at, 7 * at + 7);
    return [x, y, Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))];
  };
  const compose = (a, b) => {
    const cos = Math.cos(a[2]), sin = Math.sin(a[2]);
    return [a[0] + cos * b[0] - sin * b[1], a[1] + sin * b[0] + cos * b[1], wrapped(a[2] + b[2])];
  };
  const inverse = a => {
    const cos = Math.cos(a[2]), sin = Math.sin(a[2]);
    return [-cos * a[0] - sin * a[1], sin * a[0] - cos * a[1], -a[2]];
  };
  const between = (a, b) => compose(inverse(a), b);

  S.pose = {row, compose, inverse, between, wrapped};

  // The map by its steps alone: kept steps from one keyframe to the next, none of the loops. Of several steps
  // the surest is taken; otherwise that of the map itself is used. (K, 3) flat, in the frame of node 0.
  S.stepsAlone = () => {
    const {nodes, edges} = S.data, columns = edges.measured.shape[1];
    const surest = new Int32Array(nodes.stamps_s.length).fill(-1);
    const wide = edges.covariance.shape[1];
    const size = edge => columns === 3
      ? edges.covariance[wide * edge] + edges.covariance[wide * edge + 3] : edges.covariance[wide * edge + 15];
    for (let edge = 0; edge < edges.source.length; edge++) {
      const target = edges.target[edge];
      if (!edges.kept[edge] || edges.loop[edge] >= 0 || target !== edges.source[edge] + 1) continue;
      if (surest[target] < 0 || size(edge) < size(surest[target])) surest[target] = edge;
    }
    const poses = Float64Array.from(nodes.bases);
    for (let node = 1; node < surest.length; node++) {
      const step = surest[node] < 0
        ? between(row(nodes.bases, node - 1), row(nodes.bases, node)) : row(edges.measured, surest[node], columns);
      poses.set(compose(row(poses, node - 1), step), 3 * node);
    }
    return poses;
  };
})(Scanweave);
