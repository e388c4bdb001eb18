// Colours of the theme and scales of numbers.
"use strict";
(S => {
  // Viridis (CC0, S. van der Walt and N. Smith), in nine stops.
  const STOPS = [
    [68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99],
    [170, 220, 50], [253, 231, 37],
  ];
  // Okabe and Ito 2008, distinguishable by the colour-blind too.
  S.categories = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#f0e442", "#888888"];

  S.shade = share => {
    const at = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1);
    const low = Math.min(Math.floor(at), STOPS.length - 2);
    const mixed = STOPS[low].map((channel, n) => Math.round(channel + (at - low) * (STOPS[low + 1][n] - channel)));
    return `rgb(${mixed.join(",")})`;
  };
  S.gradient = () => `linear-gradient(90deg, ${STOPS.map(stop => `rgb(${stop.join(",")})`).join(", ")})`;

  // Lowest and highest of what is known; a hundredth at the ends does not flatten the rest.
  S.range = values => {
    const known = Float64Array.from(values.filter(Number.isFinite)).sort();
    if (!known.length) return null;
    const at = share => known[Math.round(share * (known.length - 1))];
    return {low: at(0.01), high: at(0.99), least: known[0], most: known[known.length - 1]};
  };

  // A colour of the theme as rgb(...), see style.css.
  const probe = S.element("i", {hidden: true}), known = new Map();
  S.color = name => {
    if (!known.has(name)) {
      if (!probe.isConnected) document.body.append(probe);
      probe.style.color = `var(--${name})`;
      known.set(name, getComputedStyle(probe).color);
    }
    return known.get(name);
  };

  const chosen = () => document.documentElement.dataset.theme;
  S.dark = () => chosen() ? chosen() === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  const changed = () => {
    known.clear();
    S.emit("theme");
  };
  S.switchTheme = () => {
    document.documentElement.dataset.theme = S.dark() ? "light" : "dark";
    changed();
  };
  // Paper is light.
  let before = null;
  addEventListener("beforeprint", () => {
    before = document.documentElement.dataset.theme || "";
    document.documentElement.dataset.theme = "light";
    changed();
  });
  addEventListener("afterprint", () => {
    if (before) document.documentElement.dataset.theme = before;
    else delete document.documentElement.dataset.theme;
    changed();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
})(Scanweave);
