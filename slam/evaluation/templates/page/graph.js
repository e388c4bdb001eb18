// Drawings of the graph: keyframes, steps, loops; each can be clicked.
"use strict";
(S => {
  const place = node => [S.plan.poses[3 * node], S.plan.poses[3 * node + 1]];

  function line(context, frame, from, to) {
    context.moveTo(frame.x(...from), frame.y(...from));
    context.lineTo(frame.x(...to), frame.y(...to));
  }

  // Lines between two keyframes each, all in one stroke.
  function strokes(context, frame, pairs, color, width, dash = []) {
    context.strokeStyle = color;
    context.lineWidth = width * frame.ratio;
    context.setLineDash(dash.map(part => part * frame.ratio));
    context.beginPath();
    for (const [from, to] of pairs) line(context, frame, place(from), place(to));
    context.stroke();
    context.setLineDash([]);
  }

  function dots(context, frame, nodes, color, radius) {
    context.fillStyle = color;
    context.beginPath();
    for (const node of nodes) {
      const [x, y] = place(node);
      context.moveTo(frame.x(x, y) + radius * frame.ratio, frame.y(x, y));
      context.arc(frame.x(x, y), frame.y(x, y), radius * frame.ratio, 0, 2 * Math.PI);
    }
    context.fill();
  }

  // The keyframes at both ends of what is selected.
  S.ends = chosen => {
    if (chosen.kind === "node") return [chosen.index];
    const {edges, loops} = S.data;
    if (chosen.kind === "loop") return [loops.place[chosen.index], loops.keyframe[chosen.index]];
    return [edges.source[chosen.index], edges.target[chosen.index]];
  };

  function drawSelected(context, frame) {
    const chosen = S.select.current, {edges} = S.data;
    const bold = S.plan.highlighted.map(edge => [edges.source[edge], edges.target[edge]]);
    strokes(context, frame, bold, S.color("mark"), 3);
    if (!chosen) return;
    const ends = S.ends(chosen);
    if (ends.length === 2) {
      strokes(context, frame, [ends], S.color("card"), 7);
      strokes(context, frame, [ends], S.color("mark"), 4);
    }
    dots(context, frame, ends, S.color("card"), 7.5);
    dots(context, frame, ends, S.color("mark"), 5.5);
  }

  S.ready(data => {
    if (!data.nodes) return;
    const {edges, loops, nodes} = data;
    const steps = [...edges.loop.keys()].filter(edge => edges.loop[edge] < 0);
    const accepted = [...loops.accepted.keys()].filter(loop => loops.accepted[loop]);
    const refused = [...loops.accepted.keys()].filter(loop => !loops.accepted[loop]);
    const all = [...nodes.stamps_s.keys()];
    const pickLoops = numbers => found =>
      numbers.forEach(loop => found("loop", loop, place(loops.place[loop]), place(loops.keyframe[loop])));
    const kept = steps.filter(edge => edges.kept[edge]), left = steps.filter(edge => !edges.kept[edge]);
    S.plan.add({
      name: "steps", title: `steps (${S.count(steps.length)})`, shown: false, swatch: "soft",
      legend: "Edges of the graph that are not loops; rejected ones are red.",
      draw(context, frame) {
        strokes(context, frame, kept.map(edge => [edges.source[edge], edges.target[edge]]), S.color("soft"), 1.5);
        strokes(context, frame, left.map(edge => [edges.source[edge], edges.target[edge]]), S.color("red"), 1.5, [4, 3]);
      },
      pick: found => steps.forEach(edge => found("edge", edge, place(edges.source[edge]), place(edges.target[edge]))),
    });
    if (refused.length) {
      S.plan.add({
        name: "refused", title: `loops refused (${S.count(refused.length)})`, shown: false, swatch: "red",
        legend: "Places that were compared and rejected: click one for the reason.",
        draw: (context, frame) => strokes(
          context, frame, refused.map(loop => [loops.place[loop], loops.keyframe[loop]]), S.color("red"), 0.9, [4, 3]),
        pick: pickLoops(refused),
      });
    }
    if (accepted.length) {
      S.plan.add({
        name: "loops", title: `loops (${S.count(accepted.length)})`, shown: true, swatch: "orange",
        legend: "Places that were visited again: click one.",
        draw: (context, frame) => strokes(
          context, frame, accepted.map(loop => [loops.place[loop], loops.keyframe[loop]]), S.color("orange"), 1.1),
        pick: pickLoops(accepted),
      });
    }
    S.plan.add({
      name: "keyframes", title: `keyframes (${S.count(all.length)})`, shown: true, swatch: "blue",
      legend: "Poses whose scans or images are stored: click one.",
      draw(context, frame) {
        // From afar they would hide the way.
        if (frame.pixelsAMetre / frame.ratio > 30) dots(context, frame, all, S.color("blue"), 2.6);
      },
      pick: found => all.forEach(node => found("node", node, place(node), place(node))),
    });
    S.plan.add({name: "selected", shown: true, draw: drawSelected});
    S.select.on(chosen => {
      if (chosen && chosen.look) S.plan.look(S.ends(chosen).map(place));
    });
  }, 22);
})(Scanweave);
