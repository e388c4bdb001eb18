// The parts of three.js that the page uses: clouds of points and lines in space.
import {
  BufferAttribute, BufferGeometry, Line, LineBasicMaterial, PerspectiveCamera, Points, PointsMaterial, Scene,
  WebGLRenderer,
} from "three";
import {OrbitControls} from "three/addons/controls/OrbitControls.js";

globalThis.THREE = {
  BufferAttribute, BufferGeometry, Line, LineBasicMaterial, OrbitControls, PerspectiveCamera, Points,
  PointsMaterial, Scene, WebGLRenderer,
};
