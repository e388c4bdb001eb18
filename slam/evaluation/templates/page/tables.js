// Rows of the page's tables of loops select them in the plan.
"use strict";
(S => {
  S.ready(data => {
    if (!data.loops) return;
    for (const [id, wanted] of [["accepted-loops", 1], ["refused-loops", 0]]) {
      const table = document.getElementById(id);
      if (!table) continue;
      const loops = [...data.loops.accepted.keys()].filter(loop => data.loops.accepted[loop] === wanted);
      table.classList.add("selects");
      table.tBodies[0].addEventListener("click", event => {
        const row = event.target.closest("tr");
        if (!row) return;
        S.select.set({kind: "loop", index: loops[row.sectionRowIndex], look: true});
        document.getElementById("work").scrollIntoView({behavior: S.still ? "auto" : "smooth"});
      });
    }
  }, 61);
})(Scanweave);
