// What is decided in the page: a list that can be undone, saved as edits.yaml or, in `scanweave view`, into the map.
"use strict";
(S => {
  const {element} = S;
  // Everything but the loops that the what-if panel switches: {part, value, title}; `part` as in edits.yaml.
  const items = [];
  const LISTS = ["erase", "keep_out", "slow", "places"], SINGLE = ["crop", "turn", "origin"];

  const edits = S.editing = {
    items,
    // Whether the page may save into the map itself.
    live: document.querySelector("meta[http-equiv=Content-Security-Policy]").content.includes("connect-src 'self'"),
    busy: false,

    add(part, value, title) {
      if (SINGLE.includes(part)) {
        const before = items.findIndex(item => item.part === part);
        if (before >= 0) items.splice(before, 1);
      }
      items.push({part, value, title});
      collect();
    },
    remove(item) {
      items.splice(items.indexOf(item), 1);
      collect();
    },
    download() {
      const link = element("a", {
        href: URL.createObjectURL(new Blob([S.editsText()], {type: "application/yaml"})), download: "edits.yaml",
      });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    },
    undo() {
      if (items.length) edits.remove(items[items.length - 1]);
    },
  };

  // The items as edits.yaml has them, beside what others have put there.
  function collect() {
    for (const part of [...LISTS, ...SINGLE]) delete S.edits[part];
    for (const {part, value} of items) {
      if (LISTS.includes(part)) S.edits[part] = [...S.edits[part] || [], value];
      if (SINGLE.includes(part)) S.edits[part] = value;
    }
    const added = items.filter(item => item.part === "add").map(item => item.value);
    S.edits.loops = {...S.edits.loops, add: added};
    if (!added.length) delete S.edits.loops.add;
    if (!Object.keys(S.edits.loops).length) delete S.edits.loops;
    S.emit("edits");
  }

  // A keyframe as edits.yaml names it, and as people read it.
  S.named = node => ({session: S.data.nodes.session[node] + 1, reading: S.data.nodes.readings[node]});
  const label = one => `${one.session}:${one.reading}`;

  // edits.yaml: of JSON every text is YAML, too; an entry a line can be read by people.
  const lines = (list, indent) => list.map(entry => `${indent}- ${JSON.stringify(entry)}\n`).join("");
  S.editsText = () => Object.entries(S.edits).map(([part, value]) => {
    if (Array.isArray(value) && part !== "crop" && part !== "origin") return `${part}:\n${lines(value, "  ")}`;
    if (part !== "loops") return `${part}: ${JSON.stringify(value)}\n`;
    return `loops:\n${Object.entries(value).map(([name, pairs]) => `  ${name}:\n${lines(pairs, "    ")}`).join("")}`;
  }).join("");

  // In `scanweave view`: have the map changed, and show it anew.
  async function post(where, tree) {
    edits.busy = true;
    S.emit("edits");
    let said = "";
    try {
      const answer = await fetch(where, {
        method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(tree),
      });
      const found = await answer.json();
      if (answer.ok) return location.reload();
      said = found.error;
    } catch {
      said = "The server does not answer; is 'scanweave view' still running?";
    }
    edits.busy = false;
    S.emit("edits");
    document.getElementById("edits-said").textContent = said;
  }

  function entry(text, drop) {
    const button = drop && element("button", {type: "button", class: "switch", textContent: "remove", onclick: drop});
    return element("li", {}, `${text} `, button || null);
  }

  // The loops that were switched in the what-if panel; they are switched back there.
  const switched = () => ["forbid", "force"].flatMap(name => ((S.edits.loops || {})[name] || []).map(
    pair => entry(`${name} the loop ${label(pair[0])} – ${label(pair[1])}`)));

  function list() {
    const mine = items.map(item => entry(item.title, () => edits.remove(item)));
    const all = [...mine, ...switched()];
    const none = element("p", {class: "soft", textContent: "There are no edits yet. Draw a region, name a place, add a loop, or switch loops on the What if tab."});
    return element("div", {id: "edits-list"}, element("h3", {textContent: `To be saved: ${all.length}`}),
      all.length ? element("ul", {class: "plain"}, ...all) : none);
  }

  function buttons() {
    const some = Object.keys(S.edits).length > 0, applied = S.data.applied ? S.data.applied.texts : [];
    const made = (id, textContent, disabled, onclick) => element("button", {type: "button", id, textContent, disabled, onclick});
    return element("div", {class: "choice"},
      made("edits-undo", "Undo (Ctrl+Z)", !items.length, edits.undo),
      made("edits-yaml", "Save edits.yaml", !some, edits.download),
      edits.live ? made("edits-save", edits.busy ? "Saving …" : "Save to the map", !some || edits.busy, () => post("edits", S.edits)) : null,
      edits.live && applied.length ? made("edits-back", "Undo the last saved", edits.busy, () => post("undo", {})) : null);
  }

  function saved() {
    const texts = S.data.applied ? S.data.applied.texts : [];
    if (!texts.length) return "";
    return element("details", {}, element("summary", {textContent: `In the map: ${texts.length}`}),
      ...texts.map(text => element("pre", {textContent: text})));
  }

  S.ready(data => {
    if (!data.nodes) return;
    const panel = element("div"), shown = element("div");
    const said = element("p", {id: "edits-said", class: "warning", role: "status"});
    edits.tools = element("div", {id: "edit-tools"});
    const fill = () => shown.replaceChildren(list(), buttons(), saved());
    panel.append(edits.tools, shown, said);
    S.on("edits", () => {
      said.textContent = "";
      fill();
    });
    fill();
    S.panels.add({name: "edits", title: "Edit", element: panel, order: 37});
    addEventListener("keydown", event => {
      if (!(event.ctrlKey || event.metaKey) || event.shiftKey || event.key !== "z" || !items.length) return;
      if (event.target.closest("input, textarea")) return;
      event.preventDefault();
      edits.undo();
    });
    // What is not saved is not lost without a question.
    addEventListener("beforeunload", event => {
      if (items.length && !edits.busy) event.preventDefault();
    });
  }, 46);
})(Scanweave);
