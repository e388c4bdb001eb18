// The tab of loops: all candidates in a list that can be sorted and narrowed; only the rows in sight exist.
"use strict";
(S => {
  const ROW_PX = 26, element = S.element;

  // Columns: {name, title, value: loop => number, text: loop => string}. Other parts may add theirs.
  S.loops = {
    columns: [],
    add(column) {
      this.columns.push(column);
      S.emit("loops");
    },
    sorted: null, down: true, shown: "accepted",
  };

  function rows() {
    const {accepted} = S.data.loops, {sorted, down, shown} = S.loops;
    const found = [...accepted.keys()].filter(loop => shown === "all" || Boolean(accepted[loop]) === (shown === "accepted"));
    const column = S.loops.columns.find(one => one.name === sorted);
    if (!column) return found;
    const key = loop => {
      const value = column.value(loop);
      return Number.isFinite(value) ? (down ? -value : value) : Infinity; // what is not known stays last
    };
    const keys = new Map(found.map(loop => [loop, key(loop)]));
    return found.sort((a, b) => keys.get(a) - keys.get(b) || a - b);
  }

  S.ready(data => {
    if (!data.nodes || !data.loops.place.length) return;
    const {loops, nodes} = data;
    S.loops.columns.unshift(
      {name: "from", title: "from", value: loop => loops.place[loop], text: loop => String(nodes.readings[loops.place[loop]])},
      {name: "to", title: "to", value: loop => loops.keyframe[loop], text: loop => String(nodes.readings[loops.keyframe[loop]])},
      {name: "score", title: "fit", value: loop => loops.score[loop], text: loop => S.number(loops.score[loop], 2)},
    );
    if (data.planar) {
      const cache = new Map();
      S.on("poses", () => cache.clear());
      const sigmas = loop => {
        if (!cache.has(loop)) {
          const match = S.measured({kind: "loop", index: loop});
          cache.set(loop, match ? S.residual(match.measured, match.triangle, loops.place[loop], loops.keyframe[loop]).sigmas : NaN);
        }
        return cache.get(loop);
      };
      S.loops.columns.push({name: "sigmas", title: "sigmas", value: sigmas, text: loop => S.number(sigmas(loop), 1)});
    }
    const list = element("div", {class: "rows", tabIndex: 0});
    const inner = element("div", {});
    const head = element("div", {class: "row head"});
    const filter = element("select", {id: "loops-shown", onchange: () => {
      S.loops.shown = filter.value;
      fill();
    }}, ...["accepted", "refused", "all"].map(name => element("option", {value: name, textContent: name})));
    let found = [];

    function draw() {
      const first = Math.max(0, Math.floor(list.scrollTop / ROW_PX) - 4);
      const last = Math.min(found.length, first + Math.ceil((list.clientHeight || 400) / ROW_PX) + 8);
      const current = S.select.current;
      inner.replaceChildren(...found.slice(first, last).map((loop, at) => {
        const row = element("button", {
          type: "button", class: "row", onclick: () => S.select.set({kind: "loop", index: loop, look: true}),
        }, ...S.loops.columns.map(column => element("span", {textContent: column.text(loop)})));
        row.style.top = `${(first + at) * ROW_PX}px`;
        row.dataset.loop = loop;
        if (!loops.accepted[loop]) row.classList.add("refused");
        if (current && current.kind === "loop" && current.index === loop) row.setAttribute("aria-current", "true");
        return row;
      }));
    }

    function fill() {
      found = rows();
      inner.style.height = `${found.length * ROW_PX}px`;
      head.replaceChildren(...S.loops.columns.map(column => {
        const sign = S.loops.sorted === column.name ? (S.loops.down ? " ↓" : " ↑") : "";
        return element("button", {type: "button", textContent: column.title + sign, onclick: () => {
          S.loops.down = S.loops.sorted === column.name ? !S.loops.down : true;
          S.loops.sorted = column.name;
          fill();
        }});
      }));
      draw();
    }
    list.append(inner);
    list.addEventListener("scroll", draw);
    const panel = element("div", {}, element("label", {}, "Show ", filter), element("div", {class: "list"}, head, list));
    S.select.on(draw);
    S.on("loops", fill);
    S.on("poses", fill);
    S.on("panel", name => name === "loops" && draw());
    S.panels.add({name: "loops", title: "Loops", element: panel, order: 30});
    fill();
  }, 42);
})(Scanweave);
