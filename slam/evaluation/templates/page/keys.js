// Keys, the buttons above the plan, and the list of both.
"use strict";
(S => {
  const PAN_PX = 80;
  // Other parts may add theirs: {key, does, act}.
  S.keys = [];
  S.key = (key, does, act) => S.keys.push({key, does, act});

  const view = () => S.plan.view;
  const zoom = by => view().animate({zoom: view().getZoom() + by, duration: S.still ? 0 : 150});
  const turn = degrees => view().animate({rotation: view().getRotation() + degrees * Math.PI / 180, duration: S.still ? 0 : 150});
  const pan = (right, up) => {
    const [x, y] = view().getCenter(), step = PAN_PX * view().getResolution(), angle = view().getRotation();
    const cos = Math.cos(angle), sin = Math.sin(angle);
    view().setCenter([x + step * (right * cos - up * sin), y + step * (right * sin + up * cos)]);
  };

  function typed(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    if (event.target.closest("input[type=text], input[type=number], textarea, select, [contenteditable]")) return;
    if (event.target.closest("dialog") && event.key !== "?") return;
    // What has keys of its own keeps them.
    if (event.target.closest("input[type=range], .rows") && /^Arrow|^ $/.test(event.key)) return;
    if (event.key === " " && event.target.closest("button, input, summary, a")) return;
    // Arrows move the plan only where it is looked at: elsewhere they scroll the page.
    if (/^Arrow/.test(event.key) && !event.target.closest("#plan")) return;
    const found = S.keys.find(one => one.key === event.key);
    if (found) {
      event.preventDefault();
      found.act();
    }
  }

  S.ready(() => {
    S.key("+", "nearer", () => zoom(1));
    S.key("-", "farther", () => zoom(-1));
    S.key("0", "the whole map", () => S.plan.fit(null, {duration: S.still ? 0 : 200}));
    S.key("[", "turn left", () => turn(15));
    S.key("]", "turn right", () => turn(-15));
    S.key("n", "reset the rotation", () => view().animate({rotation: 0, duration: S.still ? 0 : 150}));
    S.key("ArrowLeft", "to the left (in the plan)", () => pan(-1, 0));
    S.key("ArrowRight", "to the right (in the plan)", () => pan(1, 0));
    S.key("ArrowUp", "up (in the plan)", () => pan(0, 1));
    S.key("ArrowDown", "down (in the plan)", () => pan(0, -1));
    S.key("Escape", "clear selection and tool", () => {
      S.emit("escape");
      S.select.set(null);
    });
    S.key("d", "dark or light", S.switchTheme);
    S.key("?", "show these keys", () => help.open ? help.close() : open());
    const help = document.getElementById("keys");
    const open = () => {
      const names = {" ": "space", ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓", Escape: "Esc"};
      document.getElementById("keys-list").replaceChildren(...S.keys.flatMap(({key, does}) => [
        S.element("dt", {}, S.element("kbd", {textContent: names[key] || key})), S.element("dd", {textContent: does}),
      ]), S.element("dt", {}, S.element("kbd", {textContent: "Alt+Shift"})), S.element("dd", {textContent: "and drag: rotate"}));
      help.showModal();
    };
    document.addEventListener("keydown", typed);
    const buttons = {
      "whole": () => S.plan.fit(null, {duration: S.still ? 0 : 200}), "theme": S.switchTheme, "help": open,
      "turn-left": () => turn(15), "turn-right": () => turn(-15),
    };
    for (const [name, act] of Object.entries(buttons)) document.getElementById(name).addEventListener("click", act);
    document.getElementById("keys-close").addEventListener("click", () => help.close());
  }, 60);
})(Scanweave);
