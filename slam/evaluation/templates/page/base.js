// What all parts of the page share: where they meet (Scanweave), how they begin, what is selected, elements.
"use strict";
globalThis.Scanweave = {};
(S => {
  const beginnings = [], listeners = new Map();

  // Run `begin` once the data is there; a lower order first. Files may come in any order.
  S.ready = (begin, order = 50) => beginnings.push({begin, order});

  S.on = (event, listener) => listeners.set(event, [...(listeners.get(event) || []), listener]);
  S.emit = (event, value) => (listeners.get(event) || []).forEach(listener => listener(value));

  // What is selected: null, or {kind: "node" | "edge" | "loop", index}. Listeners hear every change.
  S.select = {
    current: null,
    on: listener => S.on("select", listener),
    set(chosen) {
      this.current = chosen;
      S.emit("select", chosen);
    },
  };

  // Edits to be saved, of the form of edits.yaml.
  S.edits = {};

  // An element; children are elements or texts. Nothing foreign is ever read as HTML.
  S.element = (tag, properties = {}, ...children) => {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(properties)) {
      if (name === "class") made.className = value;
      else if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
      else if (name in made && name !== "list") made[name] = value;
      else made.setAttribute(name, value);
    }
    made.append(...children.filter(child => child !== null && child !== undefined));
    return made;
  };

  // Tabs beside the plan: add({name, title, element, order}), show(name).
  S.panels = {
    all: [],
    add(panel) {
      panel.element.id = `panel-${panel.name}`;
      panel.element.setAttribute("role", "tabpanel");
      panel.tab = S.element("button", {
        type: "button", role: "tab", textContent: panel.title, onclick: () => this.show(panel.name),
      });
      panel.tab.setAttribute("aria-controls", panel.element.id);
      this.all = [...this.all, panel].sort((a, b) => (a.order ?? 50) - (b.order ?? 50));
      document.getElementById("tabs").replaceChildren(...this.all.map(one => one.tab));
      document.getElementById("panels").replaceChildren(...this.all.map(one => one.element));
      this.show((this.all.find(one => one.shown) || this.all[0]).name);
    },
    show(name) {
      for (const panel of this.all) {
        panel.shown = panel.name === name;
        panel.element.hidden = !panel.shown;
        panel.tab.setAttribute("aria-selected", String(panel.shown));
      }
      S.emit("panel", name);
    },
  };

  S.number = (value, digits = 3) => Number.isFinite(value) ? value.toFixed(digits) : "–";
  S.count = value => value.toLocaleString("en");
  S.duration = seconds => {
    const whole = Math.max(0, Math.round(seconds));
    return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
  };

  async function begin() {
    const work = document.getElementById("work");
    if (!work) return;
    try {
      performance.mark("decode");
      S.data = await S.decode(document.getElementById("data").textContent);
      performance.mark("begin");
      document.documentElement.classList.add("live");
      work.hidden = false;
      for (const one of beginnings.sort((a, b) => a.order - b.order)) one.begin(S.data);
      performance.mark("ready");
      document.documentElement.classList.add("ready");
      S.emit("ready");
    } catch (error) {
      // The page still shows its picture and its tables.
      document.documentElement.classList.remove("live");
      work.hidden = true;
      document.getElementById("cannot").hidden = false;
      console.error(error);
    }
  }
  document.addEventListener("DOMContentLoaded", begin);
})(Scanweave);
