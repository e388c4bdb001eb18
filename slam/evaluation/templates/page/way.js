// Drawing of the path, coloured by the chosen value, and of the keyframes' uncertainty.
"use strict";
(S => {
  const SHADES = 48, CHI2 = Math.sqrt(5.991); // 95 % of two degrees of freedom
  const way = S.way = {color: "plain", colors: []};

  // Where the way is shown: as saved, or with the keyframe before each pose where that is shown now.
  way.place = at => {
    const {xy, yaw, node} = S.data.trajectory;
    const saved = [xy[2 * at], xy[2 * at + 1], yaw[at]];
    if (!S.plan.moved || !node) return saved;
    const inside = S.pose.between(S.pose.row(S.data.nodes.bases, node[at]), saved);
    return S.pose.compose(S.pose.row(S.plan.poses, node[at]), inside);
  };

  let places = null; // flat x, y of the way as it is shown
  way.places = () => {
    const {xy} = S.data.trajectory;
    if (!S.plan.moved) return xy;
    if (!places) {
      places = new Float64Array(xy.length);
      for (let at = 0; at < xy.length / 2; at++) places.set(way.place(at).slice(0, 2), 2 * at);
    }
    return places;
  };

  // Colours of every pose: {name, title, unit, values} or {name, title, classes: [names], values: indices}.
  function colorings(trajectory) {
    const {stamps_s, sigma_m, yaw_sigma, speed, source, sources, session, sessions, more = []} = trajectory;
    const since = Float64Array.from(stamps_s, stamp => stamp - S.start());
    const found = [
      {name: "time", title: "time", unit: "s", values: since},
      {name: "sigma", title: "sigma of the position", unit: "cm", values: sigma_m.map(value => 100 * value)},
      {name: "yaw", title: "sigma of the yaw", unit: "°", values: yaw_sigma.map(value => value * 180 / Math.PI)},
      {name: "speed", title: "speed", unit: "m/s", values: speed},
    ];
    if (source) found.push({name: "source", title: "sensor in use", classes: sources, values: source});
    if (sessions && sessions.length > 1) found.push({name: "session", title: "session", classes: sessions, values: session});
    found.push(...more);
    return found.filter(one => one.values.some(Number.isFinite)).map(one => {
      const [low, high] = one.range || [];
      const range = one.classes ? null : one.range ? {low, high, least: low, most: high} : S.range(one.values);
      return {...one, range, bins: one.classes ? one.values : binned(one.values, range)};
    });
  }

  const binned = (values, {low, high}) => Uint8Array.from(values, value => Number.isFinite(value)
    ? Math.round((SHADES - 1) * Math.min(Math.max((value - low) / (high - low || 1), 0), 1)) : 255);

  way.shadeOf = (coloring, bin) => {
    if (coloring.classes) return S.categories[bin % S.categories.length];
    return bin === 255 ? S.color("soft") : S.shade(bin / (SHADES - 1));
  };

  function drawWay(context, frame) {
    const xy = way.places(), coloring = way.colors.find(one => one.name === way.color);
    const lines = new Map();
    // A step over a gap in the log, or between sessions, is no line.
    const {session} = S.data.trajectory;
    for (let at = 1; at < xy.length / 2; at++) {
      if (session && session[at] !== session[at - 1]) continue;
      const bin = coloring ? coloring.bins[at] : 0;
      if (!lines.has(bin)) lines.set(bin, new Path2D());
      const path = lines.get(bin);
      path.moveTo(frame.x(xy[2 * at - 2], xy[2 * at - 1]), frame.y(xy[2 * at - 2], xy[2 * at - 1]));
      path.lineTo(frame.x(xy[2 * at], xy[2 * at + 1]), frame.y(xy[2 * at], xy[2 * at + 1]));
    }
    context.lineCap = "round";
    context.lineWidth = (coloring ? 3 : 1.6) * frame.ratio;
    for (const [bin, path] of lines) {
      context.strokeStyle = coloring ? way.shadeOf(coloring, bin) : S.color("blue");
      context.stroke(path);
    }
    drawEnds(context, frame, xy);
  }

  function drawEnds(context, frame, xy) {
    if (!xy.length) return;
    for (const [at, color] of [[0, "green"], [xy.length - 2, "red"]]) {
      context.fillStyle = S.color(color);
      context.strokeStyle = "#fff";
      context.lineWidth = 1.5 * frame.ratio;
      context.beginPath();
      const x = frame.x(xy[at], xy[at + 1]), y = frame.y(xy[at], xy[at + 1]), side = 5 * frame.ratio;
      if (at) context.rect(x - side, y - side, 2 * side, 2 * side);
      else context.arc(x, y, side * 1.1, 0, 2 * Math.PI);
      context.fill();
      context.stroke();
    }
  }

  // The half axes of a covariance (xx, xy, yy) and the direction of the first.
  const axes = way.axes = (xx, xy, yy) => {
    const mean = (xx + yy) / 2, apart = Math.hypot((xx - yy) / 2, xy);
    return [Math.sqrt(mean + apart), Math.sqrt(Math.max(mean - apart, 0)), Math.atan2(2 * xy, xx - yy) / 2];
  };

  // Ellipses are drawn larger by a power of ten, so that the largest can be seen; the legend states it.
  function times(ellipses, extent) {
    let most = 0;
    for (let at = 0; at < ellipses.length; at += 3) most = Math.max(most, axes(...ellipses.subarray(at, at + 3))[0]);
    const seen = Math.max(extent[2] - extent[0], extent[3] - extent[1]) / 40;
    return 10 ** Math.max(0, Math.ceil(Math.log10(seen / Math.max(CHI2 * most, 1e-9))));
  }

  let start = null; // the least stamp, seconds
  S.start = () => start ??= S.data.trajectory.stamps_s.reduce((least, stamp) => Math.min(least, stamp), Infinity);

  S.ready(data => {
    way.colors = colorings(data.trajectory);
    S.on("poses", () => places = null);
    if (data.nodes && data.nodes.ellipses.length) {
      const {ellipses} = data.nodes, larger = times(ellipses, S.plan.extent());
      const count = ellipses.length / 3, step = Math.max(1, Math.floor(count / 60));
      S.plan.add({
        name: "sigma", title: "uncertainty", shown: false, swatch: "red",
        legend: `95 % ellipses${larger > 1 ? `, drawn ${S.count(larger)} times larger` : ""}, of every ${step}th keyframe.`,
        draw(context, frame) {
          context.strokeStyle = S.color("red");
          context.lineWidth = 1.2 * frame.ratio;
          for (let node = 0; node < count; node += step) {
            const [x, y] = S.pose.row(S.plan.poses, node);
            const [long, short, turn] = axes(...ellipses.subarray(3 * node, 3 * node + 3));
            context.save();
            context.beginPath();
            context.transform(...frame.transform);
            context.ellipse(x, y, larger * CHI2 * long, larger * CHI2 * short, turn, 0, 2 * Math.PI);
            context.restore();
            context.stroke();
          }
        },
      });
    }
    if (data.truth) {
      S.plan.add({
        name: "truth", title: "ground truth", shown: true, swatch: "green", legend: "The ground truth, aligned with the trajectory.",
        draw(context, frame) {
          const {xy} = data.truth;
          context.strokeStyle = S.color("green");
          context.lineWidth = 2.5 * frame.ratio;
          context.globalAlpha = 0.6;
          context.beginPath();
          for (let at = 0; at < xy.length; at += 2) context.lineTo(frame.x(xy[at], xy[at + 1]), frame.y(xy[at], xy[at + 1]));
          context.stroke();
          context.globalAlpha = 1;
        },
      });
    }
    S.plan.add({name: "way", title: "trajectory", shown: true, swatch: "blue", legend: "Green: start. Red: end.", draw: drawWay});
  }, 21);
})(Scanweave);
