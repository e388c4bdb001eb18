// The cloud in space, in WebGL; where that is not to be had the plan and the tables stay.
"use strict";
(S => {
  const element = S.element;

  function scene(canvas, {points, colors, by_intensity, low, step_m, up}) {
    const renderer = new THREE.WebGLRenderer({canvas, antialias: true, alpha: true});
    renderer.outputColorSpace = "srgb-linear"; // the colours are shown unchanged
    renderer.setClearColor(0, 0);
    const count = points.length / 3, places = new Float32Array(points.length);
    for (let at = 0; at < places.length; at++) places[at] = points[at] * step_m;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(colors, 3, true));
    geometry.computeBoundingSphere();
    const {center, radius} = geometry.boundingSphere;
    const material = new THREE.PointsMaterial({size: 2.5 * radius / Math.sqrt(count), vertexColors: true});
    const world = new THREE.Scene();
    world.add(new THREE.Points(geometry, material));
    const {xy, z} = S.data.trajectory, way = new Float32Array(3 * z.length);
    z.forEach((height, at) => way.set([xy[2 * at] - low[0], xy[2 * at + 1] - low[1], height - low[2]], 3 * at));
    const path = new THREE.BufferGeometry();
    path.setAttribute("position", new THREE.BufferAttribute(way, 3));
    const line = new THREE.LineBasicMaterial();
    world.add(new THREE.Line(path, line));
    const camera = new THREE.PerspectiveCamera(50, 1, radius / 1000, radius * 20);
    camera.up.set(...up);
    const home = () => {
      camera.position.set(center.x + 0.2 * radius, center.y - 1.1 * radius, center.z).addScaledVector(camera.up, 1.1 * radius);
      controls.target.copy(center);
      controls.update();
    };
    const controls = new THREE.OrbitControls(camera, canvas);
    let asked = false;
    const render = () => {
      if (asked) return;
      asked = true;
      requestAnimationFrame(() => {
        asked = false;
        const {clientWidth, clientHeight} = canvas.parentElement;
        renderer.setPixelRatio(Math.min(devicePixelRatio || 1, 2));
        renderer.setSize(clientWidth, clientHeight, false);
        camera.aspect = clientWidth / clientHeight;
        camera.updateProjectionMatrix();
        line.color.setRGB(...S.color("orange").match(/[\d.]+/g).slice(0, 3).map(value => Number(value) / 255));
        renderer.render(world, camera);
      });
    };
    controls.addEventListener("change", render);
    controls.listenToKeyEvents(canvas);
    addEventListener("resize", render);
    S.on("theme", render);
    home();
    render();
    const paint = values => {
      geometry.setAttribute("color", new THREE.BufferAttribute(values, 3, true));
      render();
    };
    return {count, home, byIntensity: by_intensity && (on => paint(on ? by_intensity : colors)), larger: times => {
      material.size *= times;
      render();
    }};
  }

  S.ready(data => {
    if (!data.cloud) return;
    const section = element("section", {id: "cloud", class: "work"}), canvas = element("canvas", {tabIndex: 0});
    canvas.setAttribute("aria-label", "cloud of points in space");
    document.getElementById("work").after(section);
    const box = element("div", {class: "space"}, canvas);
    section.append(element("div", {class: "toolbar"}, element("h2", {textContent: "In space"})), box);
    let shown;
    try {
      shown = scene(canvas, data.cloud);
    } catch (error) {
      // Shown to people; nothing else of the page needs WebGL.
      box.replaceChildren(element("p", {class: "soft", textContent: `The cloud cannot be shown: this browser has no WebGL (${error.message}). The plan above shows the map from above.`}));
      return;
    }
    const brightness = element("button", {type: "button", id: "cloud-intensity", textContent: "By intensity", ariaPressed: "false", onclick: () => {
      const on = brightness.ariaPressed !== "true";
      brightness.ariaPressed = String(on);
      shown.byIntensity(on);
    }});
    section.firstChild.append(
      element("button", {type: "button", id: "cloud-home", textContent: "Whole cloud", onclick: shown.home}),
      element("button", {type: "button", id: "cloud-larger", textContent: "Larger points", onclick: () => shown.larger(1.4)}),
      element("button", {type: "button", id: "cloud-smaller", textContent: "Smaller points", onclick: () => shown.larger(1 / 1.4)}),
      ...shown.byIntensity ? [brightness] : [],
      element("span", {class: "soft", textContent: `${S.count(shown.count)} points; drag to rotate, right button to pan, wheel to zoom`}),
    );
  }, 64);
})(Scanweave);
