// Drawing edits in the plan: regions, places, a line along x, a loop between two keyframes.
"use strict";
(S => {
  const {element} = S;
  const rounded = ([x, y]) => [Number(x.toFixed(3)), Number(y.toFixed(3))];
  const ring = geometry => geometry.getCoordinates()[0].slice(0, -1).map(rounded);
  const COLORS = {erase: "#c0392b", keep_out: "#8e44ad", slow: "#d68910", crop: "#1f77b4", place: "#148f77"};
  const NAMES = {erase: "erase", keep_out: "keep out", slow: "slow", crop: "crop", place: "place"};
  let active = null, pair = [];

  const name = element("input", {type: "text", id: "edit-name", maxLength: 100, placeholder: "name"});
  const later = element("input", {type: "checkbox", id: "edit-later"});
  const percent = element("input", {type: "number", id: "edit-percent", min: 1, max: 99, value: 50});
  const degrees = element("input", {type: "number", id: "edit-degrees", min: -360, max: 360, step: 0.1, value: 90});
  const hint = element("p", {class: "soft", id: "edit-hint"});

  // A name for a zone or a place that nobody has named.
  function called(kind) {
    const given = name.value.trim();
    const count = S.editing.items.filter(item => item.part === kind).length;
    name.value = "";
    return given || `${NAMES[kind] || "place"} ${count + 1}`;
  }

  // What a finished drawing means, by its tool.
  const means = {
    erase: polygon => [{name: called("erase"), polygon, ...later.checked ? {later: true} : {}}],
    keep_out: polygon => [{name: called("keep_out"), polygon}],
    slow: polygon => [{name: called("slow"), polygon, percent: Number(percent.value)}],
    crop: polygon => [polygon],
  };

  function done(tool, geometry) {
    if (tool === "places") {
      const value = {name: called("places"), position: rounded(geometry.getCoordinates())};
      S.editing.add("places", value, `place “${value.name}”`);
    } else if (tool === "origin") {
      S.editing.add("origin", rounded(geometry.getCoordinates()), "origin");
    } else if (tool === "along_x") {
      S.editing.add("turn", {along_x: geometry.getCoordinates().slice(0, 2).map(rounded)}, "x along two points");
    } else {
      const [value] = means[tool](ring(geometry));
      S.editing.add(tool, value, `${NAMES[tool]}${value.name ? ` “${value.name}”` : ""}`);
    }
  }

  function stop() {
    if (!active) return;
    if (active.draw) S.plan.map.removeInteraction(active.draw);
    active.button.setAttribute("aria-pressed", "false");
    active = null;
    pair = [];
    hint.textContent = "";
    setTimeout(() => S.plan.busy = Boolean(active), 400);
  }

  function start(tool, button) {
    const again = active && active.tool === tool;
    stop();
    if (again) return;
    S.emit("escape");
    const type = {places: "Point", origin: "Point", along_x: "LineString"}[tool] || "Polygon";
    const draw = new ol.interaction.Draw({type, maxPoints: tool === "along_x" ? 2 : undefined, style: drawn});
    draw.on("drawend", event => {
      const geometry = event.feature.getGeometry();
      stop();
      done(tool, geometry);
    });
    active = {tool, draw, button};
    S.plan.busy = true;
    button.setAttribute("aria-pressed", "true");
    hint.textContent = type === "Polygon" ? "Click the corners; finish with a double click." : type === "Point" ? "Click the point." : "Click two points.";
    S.plan.map.addInteraction(draw);
  }

  // A loop: two keyframes, clicked one after the other.
  function startPair(button) {
    const again = active && active.tool === "add";
    stop();
    if (again) return;
    active = {tool: "add", button};
    button.setAttribute("aria-pressed", "true");
    hint.textContent = "Click two keyframes that see the same place.";
  }
  function picked(chosen) {
    if (!active || active.tool !== "add" || !chosen || chosen.kind !== "node") return;
    if (!pair.includes(chosen.index)) pair.push(chosen.index);
    hint.textContent = "Click the other keyframe.";
    if (pair.length < 2) return;
    const ends = pair.map(S.named);
    stop();
    S.editing.add("add", {pair: ends}, `add a loop ${ends.map(one => `${one.session}:${one.reading}`).join(" – ")}`);
    S.panels.show("edits");
  }

  function drawn(feature) {
    const kind = feature.get("kind") || (active ? active.tool : "erase"), color = COLORS[kind] || COLORS.place;
    return new ol.style.Style({
      stroke: new ol.style.Stroke({color, width: 2, lineDash: feature.get("saved") ? undefined : [6, 4]}),
      fill: new ol.style.Fill({color: `${color}22`}),
      image: new ol.style.Circle({radius: 5, fill: new ol.style.Fill({color}), stroke: new ol.style.Stroke({color: S.color("card"), width: 1.5})}),
      text: new ol.style.Text({
        text: feature.get("title") || "", font: "600 12px system-ui, sans-serif", overflow: true, offsetY: -14,
        fill: new ol.style.Fill({color: S.color("ink")}), stroke: new ol.style.Stroke({color: S.color("card"), width: 3}),
      }),
    });
  }

  const feature = (points, kind, title, saved) => new ol.Feature({
    geometry: points.length === 1 ? new ol.geom.Point(points[0]) : points.length === 2
      ? new ol.geom.LineString(points) : new ol.geom.Polygon([[...points, points[0]]]),
    kind, title, saved,
  });

  // What is in the map, and what is to be saved.
  function show(source) {
    source.clear();
    const regions = S.data.applied ? S.data.applied.regions : [];
    for (const one of regions) source.addFeature(feature(one.points, one.kind, one.name || NAMES[one.kind], true));
    for (const {part, value, title} of S.editing.items) {
      if (value.polygon) source.addFeature(feature(value.polygon, part, title, false));
      if (part === "crop") source.addFeature(feature(value, part, title, false));
      if (part === "places") source.addFeature(feature([value.position], "place", value.name, false));
      if (part === "origin") source.addFeature(feature([value], "place", "0, 0", false));
      if (part === "turn" && value.along_x) source.addFeature(feature(value.along_x, "place", "x", false));
    }
  }

  S.ready(data => {
    if (!data.nodes) return;
    const layer = S.plan.vectors(drawn);
    const tool = (id, title, act) => {
      const button = element("button", {type: "button", id: `edit-${id}`, textContent: title, onclick: () => act(button)});
      button.setAttribute("aria-pressed", "false");
      return button;
    };
    const draws = (part, title) => tool(part.replace("_", "-"), title, button => start(part, button));
    const label = (input, text) => element("label", {}, input, ` ${text}`);
    const row = (...parts) => element("div", {class: "choice"}, ...parts);
    S.editing.tools.append(
      row(name, draws("places", "Place"), draws("origin", "Origin"), tool("add", "Add a loop", startPair)),
      row(draws("erase", "Erase"), label(later, "also in later sessions"), draws("crop", "Crop")),
      row(draws("keep_out", "Keep out"), draws("slow", "Slow"), label(percent, "% of its speed")),
      row(tool("walls", "Align with the walls", () => S.editing.add("turn", {to_walls: true}, "align with the walls")),
        draws("along_x", "x along two points")),
      row(tool("turn", "Rotate by", () => S.editing.add("turn", {degrees: Number(degrees.value)}, `rotate by ${degrees.value}°`)),
        label(degrees, "degrees")),
      hint);
    S.select.on(picked);
    S.on("escape", stop);
    S.on("theme", () => layer.layer.changed());
    S.on("edits", () => show(layer.source));
    show(layer.source);
  }, 64);
})(Scanweave);
