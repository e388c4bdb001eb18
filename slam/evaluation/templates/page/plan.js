// The plan: a view of the map in metres with pan, zoom and rotation, pictures below, drawings above.
"use strict";
(S => {
  const NEAR_PX = 9;
  const rasters = [], drawings = [];

  // A canvas that is drawn anew for every frame of the view; draw(context, frame) in device pixels.
  function canvasLayer(className, draw) {
    const canvas = S.element("canvas", {class: className});
    canvas.style.cssText = "position:absolute;left:0;top:0;width:100%;height:100%";
    return new ol.layer.Layer({
      render(state) {
        const [width, height] = state.size.map(side => Math.round(side * state.pixelRatio));
        if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
        const context = canvas.getContext("2d");
        context.setTransform(1, 0, 0, 1, 0, 0);
        context.clearRect(0, 0, width, height);
        const [a, b, c, d, e, f] = state.coordinateToPixelTransform.map(value => value * state.pixelRatio);
        draw(context, {
          width, height, ratio: state.pixelRatio, transform: [a, b, c, d, e, f],
          pixelsAMetre: Math.hypot(a, b),
          x: (x, y) => a * x + c * y + e, y: (x, y) => b * x + d * y + f,
        });
        return canvas;
      },
    });
  }

  function drawRasters(context, frame) {
    for (const raster of rasters.filter(one => one.shown && one.image.complete && one.image.naturalWidth)) {
      const [x, y, yaw] = raster.corner, cell = raster.resolution_m;
      const cos = cell * Math.cos(yaw), sin = cell * Math.sin(yaw);
      context.save();
      context.setTransform(...frame.transform);
      // From pixels of the picture, row 0 at the top, to the map.
      context.transform(cos, sin, sin, -cos, x - sin * raster.rows, y + cos * raster.rows);
      context.imageSmoothingEnabled = frame.pixelsAMetre * cell < 2;
      context.globalAlpha = raster.opacity * plan.ground;
      context.drawImage(raster.image, 0, 0);
      context.restore();
    }
  }

  const plan = S.plan = {
    rasters, drawings,
    // How strongly the pictures show: weaker where the drawings above have moved away from them.
    ground: 1,
    // (K, 3) flat x, y, yaw of the keyframes as they are shown, and whether that is not the map itself.
    poses: null, moved: false,

    // A drawing: {name, title, shown, draw(context, frame), legend}. The later lies above.
    add(drawing) {
      drawings.push(drawing);
      S.emit("layers");
      this.render();
    },
    // Vectors of a part of the page (an area, a length): an OpenLayers layer above all drawings.
    vectors(style) {
      const source = new ol.source.Vector();
      const layer = new ol.layer.Vector({source, style, updateWhileAnimating: true, updateWhileInteracting: true});
      this.map.addLayer(layer);
      return {source, layer};
    },
    render: () => plan.map && plan.map.render(),
    show(name, shown) {
      for (const one of [...rasters, ...drawings]) if (one.name === name) one.shown = shown;
      S.emit("layers");
      this.render();
    },
    // Show the keyframes, scans and the way elsewhere; null for the map as it was saved. Rows of 3 columns, or of
    // 7 in space.
    showPoses(poses) {
      const {bases} = S.data.nodes;
      if (!poses) {
        this.poses = bases;
      } else if (poses.length === bases.length) {
        this.poses = poses;
      } else {
        this.poses = new Float64Array(bases.length);
        for (let at = 0; at < bases.length / 3; at++) this.poses.set(S.pose.row(poses, at, 7), 3 * at);
      }
      this.moved = Boolean(poses);
      this.ground = this.moved ? 0.35 : 1;
      if (this.moved) this.show("scans", true);
      S.emit("poses");
      this.render();
    },
    // Edges to be drawn boldly, by their numbers.
    highlighted: [],
    highlight(edges) {
      this.highlighted = Array.from(edges);
      this.render();
    },
    // [xmin, ymin, xmax, ymax] of all that there is.
    extent() {
      const extent = ol.extent.createEmpty();
      for (const one of rasters) {
        for (const [u, v] of [[0, 0], [one.cols, 0], [0, one.rows], [one.cols, one.rows]]) {
          const corner = S.pose.compose(one.corner, [u * one.resolution_m, v * one.resolution_m, 0]);
          ol.extent.extend(extent, [corner[0], corner[1], corner[0], corner[1]]);
        }
      }
      const {xy} = S.data.trajectory;
      for (let at = 0; at < xy.length; at += 2) {
        if (Number.isFinite(xy[at] + xy[at + 1])) ol.extent.extend(extent, [xy[at], xy[at + 1], xy[at], xy[at + 1]]);
      }
      return ol.extent.isEmpty(extent) ? [-1, -1, 1, 1] : ol.extent.buffer(extent, 0.5);
    },
    fit(extent, options = {}) {
      this.view.fit(extent || this.extent(), {padding: [12, 12, 12, 12], maxZoom: undefined, ...options});
    },
    // Bring points [[x, y], ...] into sight.
    look(points, least_m = 4) {
      const extent = ol.extent.boundingExtent(points);
      const lacking = least_m - Math.max(extent[2] - extent[0], extent[3] - extent[1]);
      this.fit(ol.extent.buffer(extent, Math.max(lacking / 2, 0.5)), {duration: S.still ? 0 : 250, padding: [60, 60, 60, 60]});
    },
    // While a tool takes the clicks (measuring, drawing), they select nothing.
    busy: false,
  };

  // Distance in pixels from p to the segment a b.
  function apart(p, a, b) {
    const length2 = (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2;
    const along = length2 ? ((p[0] - a[0]) * (b[0] - a[0]) + (p[1] - a[1]) * (b[1] - a[1])) / length2 : 0;
    const at = Math.min(Math.max(along, 0), 1);
    return Math.hypot(p[0] - a[0] - at * (b[0] - a[0]), p[1] - a[1] - at * (b[1] - a[1]));
  }

  // What lies under a pixel: the nearest of what can be selected and is shown, nodes before lines.
  plan.at = pixel => {
    const reach = plan.view.getResolution() * NEAR_PX;
    const place = plan.map.getCoordinateFromPixel(pixel);
    const best = {node: null, line: null, nodeApart: reach, lineApart: reach};
    for (const drawing of drawings.filter(one => one.shown && one.pick)) {
      drawing.pick((kind, index, a, b) => {
        const distance = apart(place, a, b);
        const which = kind === "node" ? "node" : "line";
        if (distance < best[`${which}Apart`]) {
          best[which] = {kind, index};
          best[`${which}Apart`] = distance;
        }
      });
    }
    return best.node || best.line;
  };

  function clicked(event) {
    if (plan.busy) return;
    S.select.set(plan.at(event.pixel));
  }

  function hovered(event) {
    if (event.dragging || plan.busy) return;
    const [x, y] = event.coordinate;
    document.getElementById("position").textContent = `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m`;
    plan.map.getTargetElement().style.cursor = plan.at(event.pixel) ? "pointer" : "";
  }

  S.ready(data => {
    S.still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    for (const [number, layer] of data.layers.entries()) {
      const image = new Image();
      image.onload = plan.render;
      image.src = layer.png;
      rasters.push({...layer, title: layer.name, image, shown: number === 0, opacity: 1});
    }
    plan.poses = data.nodes ? data.nodes.bases : new Float64Array();
    const projection = new ol.proj.Projection({code: "map", units: "m", metersPerUnit: 1, extent: [-1e6, -1e6, 1e6, 1e6]});
    plan.view = new ol.View({
      projection, center: [0, 0], resolution: 1, minResolution: 0.0005, maxResolution: 1000,
      constrainResolution: false, constrainRotation: false, smoothExtentConstraint: false, showFullExtent: true,
    });
    plan.map = new ol.Map({
      target: "plan", view: plan.view,
      // Keys act while the plan has the focus: its element can be tabbed to.
      controls: ol.control.defaults({attribution: false, rotateOptions: {autoHide: true, tipLabel: "Reset the rotation (n)"}}).extend([
        new ol.control.ScaleLine({minWidth: 80}),
      ]),
      interactions: ol.interaction.defaults({doubleClickZoom: false}).extend([
        new ol.interaction.DragRotate({condition: ol.events.condition.altKeyOnly}),
      ]),
      layers: [canvasLayer("rasters", drawRasters), canvasLayer("drawings", (context, frame) => {
        for (const drawing of drawings) if (drawing.shown) drawing.draw(context, frame);
      })],
    });
    plan.map.on("singleclick", clicked);
    plan.map.on("pointermove", hovered);
    // Once all panels have taken their room.
    S.on("ready", () => {
      plan.map.updateSize();
      plan.fit();
    });
    S.on("theme", plan.render);
    S.select.on(plan.render);
  }, 10);
})(Scanweave);
