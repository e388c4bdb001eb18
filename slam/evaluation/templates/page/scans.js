// Drawings of points: the keyframes' scans, and what fusion repaired of them.
"use strict";
(S => {
  let spare = null; // a canvas of the same size as the plan's, for pixels

  // rgb(...) as a pixel.
  const pixel = color => {
    const [red, green, blue] = color.match(/[\d.]+/g).map(Number);
    return new Uint32Array(new Uint8ClampedArray([red, green, blue, 255]).buffer)[0];
  };

  // Draw points of some keyframes. colors: of each kind, as returned by S.color.
  S.drawPoints = (context, frame, {first, points, kind}, colors, nodes, poses = S.plan.poses) => {
    const {width, height, transform: [a, b, c, d, e, f]} = frame;
    if (!spare || spare.width !== width || spare.height !== height) {
      spare = S.element("canvas", {width, height}).getContext("2d");
    }
    const image = spare.createImageData(width, height), pixels = new Uint32Array(image.data.buffer);
    const packed = colors.map(pixel);
    const side = Math.max(1, Math.min(3, Math.round(frame.pixelsAMetre / 40 * frame.ratio)));
    for (const node of nodes) {
      const x0 = poses[3 * node], y0 = poses[3 * node + 1], yaw = poses[3 * node + 2];
      // Centimetres of the base frame to pixels.
      const cos = Math.cos(yaw) / 100, sin = Math.sin(yaw) / 100;
      const ux = a * cos + c * sin, vx = -a * sin + c * cos, px = a * x0 + c * y0 + e;
      const uy = b * cos + d * sin, vy = -b * sin + d * cos, py = b * x0 + d * y0 + f;
      for (let at = first[node]; at < first[node + 1]; at++) {
        const x = (px + ux * points[2 * at] + vx * points[2 * at + 1]) | 0;
        const y = (py + uy * points[2 * at] + vy * points[2 * at + 1]) | 0;
        if (x < 0 || y < 0 || x + side > width || y + side > height) continue;
        const color = packed[kind ? kind[at] : 0];
        for (let v = 0; v < side; v++) for (let u = 0; u < side; u++) pixels[(y + v) * width + x + u] = color;
      }
    }
    spare.putImageData(image, 0, 0);
    context.drawImage(spare.canvas, 0, 0);
  };

  S.ready(data => {
    if (!data.nodes) return;
    const all = [...data.nodes.stamps_s.keys()];
    if (data.scans.points.length) {
      S.plan.add({
        name: "scans", title: "scans of the keyframes", shown: false, swatch: "scan",
        legend: "All lidar points, at the poses of their keyframes.",
        draw: (context, frame) => S.drawPoints(context, frame, data.scans, [S.color("scan")], all),
      });
    }
    if (data.repairs.points.length) {
      const colors = ["orange", "blue", "red"];
      S.plan.add({
        name: "repairs", title: "fused repairs", shown: false, swatch: "orange",
        legend: "Orange: filled readings. Blue: corrected readings. Red: where these were before.",
        draw: (context, frame) => S.drawPoints(context, frame, data.repairs, colors.map(S.color), all),
      });
    }
  }, 20);
})(Scanweave);
