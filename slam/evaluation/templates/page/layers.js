// The tab of layers: pictures and drawings on and off, and what the way is coloured by.
"use strict";
(S => {
  const element = S.element;

  function toggle(layer) {
    const box = element("input", {type: "checkbox", checked: layer.shown, onchange: () => S.plan.show(layer.name, box.checked)});
    const swatch = layer.swatch ? element("i", {class: "swatch"}) : null;
    if (swatch) swatch.style.background = `var(--${layer.swatch})`;
    box.dataset.layer = layer.name;
    return element("div", {class: "layer"}, element("label", {}, box, " ", swatch, layer.title),
      layer.legend && layer.shown ? element("p", {class: "soft", textContent: layer.legend}) : null);
  }

  // Of the pictures one is shown, or none, and those that lie over it.
  function choice(raster) {
    const label = element("label", {});
    const box = element("input", {type: "checkbox", checked: raster.shown, onchange: () => {
      if (!raster.over) for (const one of S.plan.rasters) if (!one.over) one.shown = false;
      S.plan.show(raster.name, box.checked);
    }});
    box.dataset.layer = raster.name;
    label.append(box, " ", raster.title);
    return element("div", {class: "layer"}, label,
      raster.shown ? element("p", {class: "soft", textContent: raster.legend}) : null);
  }

  function colorBar() {
    const coloring = S.way.colors.find(one => one.name === S.way.color);
    if (!coloring) return null;
    if (coloring.classes) {
      return element("p", {class: "soft"}, ...coloring.classes.flatMap((name, number) => {
        const swatch = element("i", {class: "swatch"});
        swatch.style.background = S.way.shadeOf(coloring, number);
        return coloring.values.includes(number) ? [element("span", {class: "entry"}, swatch, name)] : [];
      }));
    }
    const bar = element("div", {class: "gradient"}), {low, high, least, most} = coloring.range;
    bar.style.background = S.gradient();
    const digits = high - low >= 20 ? 0 : 2;
    const text = (value, end) => `${value.toFixed(digits)} ${coloring.unit}${end === value ? "" : ` (${end.toFixed(digits)})`}`;
    return element("div", {class: "scale"}, bar, element("span", {textContent: text(low, least)}),
      element("span", {textContent: text(high, most)}));
  }

  function colorings() {
    const select = element("select", {id: "color", onchange: () => {
      S.way.color = select.value;
      S.emit("layers");
      S.plan.render();
    }}, element("option", {value: "plain", textContent: "one colour"}),
    ...S.way.colors.map(one => element("option", {value: one.name, textContent: one.title})));
    select.value = S.way.color;
    return element("div", {class: "coloring"}, element("label", {}, "Trajectory coloured by ", select), colorBar());
  }

  S.ready(data => {
    const panel = element("div");
    const fill = () => panel.replaceChildren(
      ...(S.plan.rasters.length ? [element("h3", {textContent: "Map"}), ...S.plan.rasters.map(choice)] : []),
      element("h3", {textContent: "Overlays"}),
      ...S.plan.drawings.filter(one => one.title).toReversed().map(toggle),
      colorings(),
      ...data.limits.map(line => element("p", {class: "soft", textContent: line})),
    );
    S.on("layers", fill);
    S.on("theme", fill);
    fill();
    S.panels.add({name: "layers", title: "Layers", element: panel, order: 10});
  }, 40);
})(Scanweave);
