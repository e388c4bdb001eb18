// Lengths and areas, measured by clicks in the plan.
"use strict";
(S => {
  const units = (value, unit) => `${value.toFixed(value < 10 ? 3 : 2)} ${unit}`;

  function text(geometry) {
    if (geometry instanceof ol.geom.Polygon) {
      const ring = new ol.geom.LineString(geometry.getCoordinates()[0]);
      return `${units(geometry.getArea(), "m²")}\naround ${units(ring.getLength(), "m")}`;
    }
    return units(geometry.getLength(), "m");
  }

  function style(feature) {
    const geometry = feature.getGeometry(), color = S.color("mark");
    const line = new ol.style.Style({
      stroke: new ol.style.Stroke({color, width: 2.5}), fill: new ol.style.Fill({color: `color-mix(in srgb, ${color} 15%, transparent)`}),
      image: new ol.style.Circle({radius: 4, fill: new ol.style.Fill({color})}),
    });
    if (geometry instanceof ol.geom.Point) return [line];
    const place = geometry instanceof ol.geom.Polygon ? geometry.getInteriorPoint() : new ol.geom.Point(geometry.getLastCoordinate());
    const label = new ol.style.Style({
      geometry: place,
      text: new ol.style.Text({
        text: text(geometry), font: "600 13px system-ui, sans-serif", overflow: true, offsetY: -16,
        fill: new ol.style.Fill({color: S.color("ink")}), backgroundFill: new ol.style.Fill({color: S.color("card")}), padding: [3, 5, 2, 5],
      }),
    });
    return [line, label];
  }

  S.ready(() => {
    const layer = S.plan.vectors(style), tools = document.getElementById("tools");
    let active = null;
    const buttons = [["length", "LineString", "Length", "l"], ["area", "Polygon", "Area", "a"]].map(([name, type, title, key]) => {
      const button = S.element("button", {
        type: "button", id: `measure-${name}`, textContent: title, title: `measure: click points, finish with a double click (${key})`,
        onclick: () => active && active.name === name ? stop() : start(name, type, button),
      });
      button.setAttribute("aria-pressed", "false");
      S.key(key, `measure ${title.toLowerCase()}`, () => button.click());
      return button;
    });
    const clear = S.element("button", {type: "button", id: "measure-clear", textContent: "Clear", hidden: true, onclick: () => {
      stop();
      layer.source.clear();
      clear.hidden = true;
    }});

    function stop() {
      if (!active) return;
      S.plan.map.removeInteraction(active.draw);
      active.button.setAttribute("aria-pressed", "false");
      active = null;
      // The click that ended it still comes.
      setTimeout(() => S.plan.busy = Boolean(active), 400);
    }
    function start(name, type, button) {
      stop();
      const draw = new ol.interaction.Draw({source: layer.source, type, style});
      draw.on("drawend", () => {
        clear.hidden = false;
        stop();
      });
      active = {name, draw, button};
      S.plan.busy = true;
      button.setAttribute("aria-pressed", "true");
      S.plan.map.addInteraction(draw);
    }
    S.on("escape", stop);
    S.on("theme", () => layer.layer.changed());
    tools.append(...buttons, clear);
  }, 63);
})(Scanweave);
