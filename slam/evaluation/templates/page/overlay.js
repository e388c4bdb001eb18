// Two keyframes' scans over each other: as the steps alone lay them, as they were matched, as the map has them.
"use strict";
(S => {
  const SIDE = 300, AROUND = 12; // keyframes before and after the place that a loop is compared with
  let alone = null, shown = "map";

  // Where the target lies, seen from the source.
  function views(chosen) {
    const [from, to] = S.ends(chosen), match = S.measured(chosen);
    const relative = poses => S.pose.between(S.pose.row(poses, from), S.pose.row(poses, to));
    const found = [];
    // Cameras look where they like: their steps are not of the plane.
    const lifted = S.data.planar || S.data.scans.points.length > 0;
    if (chosen.kind === "loop" && lifted) {
      alone = alone || S.stepsAlone();
      found.push({name: "steps", title: "by odometry edges only", pose: relative(alone)});
    }
    if (match) found.push({name: "match", title: "as matched", pose: match.measured});
    found.push({name: "map", title: S.plan.moved ? "as shown" : "in the map", pose: relative(S.plan.poses)});
    return found;
  }

  const points = (node, pose) => {
    const {first, points: all} = S.data.scans, cos = Math.cos(pose[2]), sin = Math.sin(pose[2]);
    const found = [];
    for (let at = first[node]; at < first[node + 1]; at++) {
      const x = all[2 * at] / 100, y = all[2 * at + 1] / 100;
      found.push([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y]);
    }
    return found;
  };

  // The place as a loop sees it: the scans around it, as the map lays them.
  function ground(from, to, wide) {
    const nodes = [];
    for (let node = Math.max(0, from - wide); node <= Math.min(S.data.nodes.stamps_s.length - 1, from + wide); node++) {
      if (node === from || Math.abs(node - to) > wide) nodes.push(node);
    }
    const base = S.pose.row(S.plan.poses, from);
    return nodes.flatMap(node => points(node, S.pose.between(base, S.pose.row(S.plan.poses, node))));
  }

  function draw(canvas, below, above, robot) {
    const context = canvas.getContext("2d"), ratio = canvas.width / SIDE;
    // The window is what most of the scan's points ask for: a beam through a window would shrink all.
    const ends = axis => {
      const sorted = above.map(point => point[axis]).sort((a, b) => a - b), last = sorted.length - 1;
      return last < 0 ? [-2, 2] : [Math.min(sorted[Math.round(0.05 * last)], -1) - 1, Math.max(sorted[Math.round(0.95 * last)], 1) + 1];
    };
    const [[x0, x1], [y0, y1]] = [ends(0), ends(1)];
    const scale = canvas.width / Math.max(x1 - x0, y1 - y0) * 0.94;
    const at = (x, y) => [canvas.width / 2 + scale * (x - (x0 + x1) / 2), canvas.height / 2 - scale * (y - (y0 + y1) / 2)];
    context.fillStyle = S.color("card");
    context.fillRect(0, 0, canvas.width, canvas.height);
    for (const [some, color, side] of [[below, "soft", 1.6], [above, "orange", 2.2]]) {
      context.fillStyle = S.color(color);
      for (const [x, y] of some) {
        const [u, v] = at(x, y);
        context.fillRect(u - side * ratio / 2, v - side * ratio / 2, side * ratio, side * ratio);
      }
    }
    for (const [pose, color] of robot) {
      context.strokeStyle = S.color(color);
      context.lineWidth = 2 * ratio;
      context.beginPath();
      context.moveTo(...at(...S.pose.compose(pose, [0.3, 0, 0])));
      context.lineTo(...at(pose[0], pose[1]));
      context.stroke();
      context.beginPath();
      context.arc(...at(pose[0], pose[1]), 4 * ratio, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  // An element that shows them, or null where there are no scans.
  S.overlay = chosen => {
    const {scans} = S.data, [from, to] = S.ends(chosen);
    if (!scans.points.length || scans.first[from] === scans.first[from + 1]) return null;
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const canvas = S.element("canvas", {class: "overlay", width: SIDE * ratio, height: SIDE * ratio});
    if (chosen.kind === "node") {
      draw(canvas, [], points(from, [0, 0, 0]), [[[0, 0, 0], "orange"]]);
      return canvas;
    }
    const below = ground(from, to, chosen.kind === "loop" ? AROUND : 0), all = views(chosen);
    const buttons = all.map(view => S.element("button", {
      type: "button", textContent: view.title, onclick: () => {
        shown = view.name;
        fill();
      },
    }));
    const fill = () => {
      const view = all.find(one => one.name === shown) || all[all.length - 1];
      draw(canvas, below, points(to, view.pose), [[[0, 0, 0], "soft"], [view.pose, "orange"]]);
      buttons.forEach((button, number) => button.setAttribute("aria-pressed", String(all[number] === view)));
      canvas.setAttribute("aria-label", `${S.keyframe(to)} over ${S.keyframe(from)}, ${view.title}`);
    };
    canvas.setAttribute("role", "img");
    fill();
    return S.element("div", {}, canvas, S.element("div", {class: "choice"}, ...buttons),
      S.element("p", {class: "soft", textContent: `Grey: ${S.keyframe(from)}${chosen.kind === "loop" ? " and around it" : ""}. Orange: ${S.keyframe(to)}.`}));
  };
})(Scanweave);
