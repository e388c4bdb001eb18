// Plays the drive: the robot, its scan, what its camera saw.
"use strict";
(S => {
  const element = S.element, SPEEDS = [1, 4, 16, 64], GAP_S = 2;
  let elapsed = null; // seconds of playing time of every pose: a clock that jumps back or far ahead does not
  let at = -1, playing = null, box, slider, readout, button, speed, address = null;

  // The last of sorted values that is not above one.
  function before(values, value) {
    let low = 0, high = values.length;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (values[middle] <= value) low = middle;
      else high = middle;
    }
    return low;
  }

  function show(index) {
    const {trajectory, nodes, images} = S.data;
    at = Math.min(Math.max(index, 0), elapsed.length - 1);
    slider.value = String(elapsed[at]);
    const parts = [`${(trajectory.stamps_s[at] - S.start()).toFixed(1)} s`];
    if (Number.isFinite(trajectory.speed[at])) parts.push(`${trajectory.speed[at].toFixed(2)} m/s`);
    if (Number.isFinite(trajectory.sigma_m[at])) parts.push(`± ${(100 * trajectory.sigma_m[at]).toFixed(1)} cm`);
    if (nodes) parts.push(S.keyframe(trajectory.node[at]));
    readout.textContent = parts.join(" · ");
    if (images) showImages(images, trajectory.node[at]);
    S.plan.render();
    S.emit("moment", at);
  }

  // Of every camera the newest image up to a keyframe.
  function showImages(images, node) {
    const shown = images.cameras.map((_, camera) => {
      let best = -1;
      images.node.forEach((at, number) => {
        if (images.camera[number] === camera && at <= node) best = number;
      });
      return best;
    }).filter(number => number >= 0);
    if (shown.join() === box.dataset.shown) return;
    box.dataset.shown = shown.join();
    (address || []).forEach(one => URL.revokeObjectURL(one));
    address = shown.map(number => S.image(number));
    box.replaceChildren(...shown.map((number, at) => element("img", {src: address[at], alt: images.cameras[images.camera[number]]})));
  }

  // An address of a small image; the caller revokes it.
  S.image = number => {
    const {first, bytes} = S.data.images;
    return URL.createObjectURL(new Blob([bytes.slice(first[number], first[number + 1])], {type: "image/jpeg"}));
  };

  function stop() {
    cancelAnimationFrame(playing);
    playing = null;
    button.textContent = "▶";
    button.title = button.ariaLabel = "play (space)";
  }

  function play() {
    if (playing !== null) return stop();
    let last = performance.now(), moment = at >= elapsed.length - 1 ? 0 : elapsed[Math.max(at, 0)];
    button.textContent = "❚❚";
    button.title = button.ariaLabel = "stop (space)";
    const step = now => {
      moment += (now - last) / 1000 * Number(speed.value);
      last = now;
      show(before(elapsed, moment));
      if (moment >= elapsed[elapsed.length - 1]) stop();
      else playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  }

  function drawRobot(context, frame) {
    if (at < 0) return;
    const {nodes, scans, trajectory} = S.data, pose = S.way.place(at);
    if (nodes && scans.points.length) S.drawPoints(context, frame, scans, [S.color("mark")], [trajectory.node[at]]);
    const size = Math.max(0.25 * frame.pixelsAMetre, 8 * frame.ratio) / frame.pixelsAMetre;
    context.beginPath();
    for (const [x, y] of [[1, 0], [-0.7, 0.7], [-0.35, 0], [-0.7, -0.7]]) {
      const corner = S.pose.compose(pose, [size * x, size * y, 0]);
      context.lineTo(frame.x(corner[0], corner[1]), frame.y(corner[0], corner[1]));
    }
    context.closePath();
    context.fillStyle = S.color("mark");
    context.strokeStyle = S.color("card");
    context.lineWidth = 1.5 * frame.ratio;
    context.fill();
    context.stroke();
  }

  S.ready(data => {
    const {stamps_s} = data.trajectory;
    if (stamps_s.length < 2) return;
    elapsed = new Float64Array(stamps_s.length);
    for (let index = 1; index < elapsed.length; index++) {
      elapsed[index] = elapsed[index - 1] + Math.min(Math.max(stamps_s[index] - stamps_s[index - 1], 0), GAP_S);
    }
    const whole = elapsed[elapsed.length - 1] || 1;
    button = element("button", {type: "button", id: "play", textContent: "▶", onclick: play});
    button.title = button.ariaLabel = "play (space)";
    slider = element("input", {type: "range", id: "moment", ariaLabel: "time in the log", oninput: () => {
      stop();
      show(before(elapsed, Number(slider.value)));
    }});
    Object.assign(slider, {min: "0", max: String(whole), step: String(whole / 2000), value: "0"});
    speed = element("select", {id: "speed", ariaLabel: "speed"}, ...SPEEDS.map(
      times => element("option", {value: String(times), textContent: `${times}×`})));
    speed.value = whole > 300 ? "16" : "4";
    readout = element("output", {id: "readout", textContent: S.duration(whole)});
    box = element("div", {id: "thumbnails"});
    document.getElementById("player").append(button, slider, speed, readout, box);
    S.plan.add({name: "robot", shown: true, draw: drawRobot});
    S.key(" ", "play, or stop", play);
    S.key(",", "step back", () => show(at - 1));
    S.key(".", "step forward", () => show(at + 1));
    // seek(seconds since the start); stamps may run backward: the nearest.
    S.player = {seek(seconds) {
      let best = 0;
      const wanted = seconds + S.start();
      stamps_s.forEach((stamp, index) => {
        if (Math.abs(stamp - wanted) < Math.abs(stamps_s[best] - wanted)) best = index;
      });
      show(best);
    }, show, get at() { return at; }};
  }, 62);
})(Scanweave);
