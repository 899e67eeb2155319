// The shapes of the laboratory's MJCF file as objects of three.js, and its axes.
import { THREE } from "nicegui-scene";

const AXES = [["x", 0xff6b6b, [1, 0, 0]], ["y", 0x63c174, [0, 1, 0]], ["z", 0x5aa9ff, [0, 0, 1]]];

// A `Shape` of scene_shapes.py. The field of view and the rim shine.
export function solid({ name, kind, size_m: size, position_m, parent_from_shape_wxyz: wxyz, rgba, vertices_m, faces }) {
  const [red, green, blue, alpha] = rgba, color = new THREE.Color().setRGB(red, green, blue, THREE.SRGBColorSpace);
  const field = /^stage_(field|ray|edge)/.test(name), shines = field || name === "stage_rim_inside";
  const material = new THREE.MeshLambertMaterial({
    color, transparent: alpha < 1, opacity: alpha, depthWrite: alpha >= 1,
    flatShading: kind === "mesh" && !name.startsWith("stage"), side: field ? THREE.DoubleSide : THREE.FrontSide,
    emissive: shines ? color : 0x000000, emissiveIntensity: 0.6,
  });
  if (kind === "plane") {
    material.map = tiles(size[0]);
    material.color.set(0xffffff);
  }
  const mesh = new THREE.Mesh(form(kind, size, vertices_m, faces), material);
  mesh.position.set(...position_m);
  mesh.quaternion.set(wxyz[1], wxyz[2], wxyz[3], wxyz[0]);
  mesh.name = name;
  return mesh;
}

// MuJoCo's axis of a cylinder and a capsule is z, that of three.js is y.
function form(kind, size, vertices, faces) {
  if (kind === "box") return new THREE.BoxGeometry(2 * size[0], 2 * size[1], 2 * size[2]);
  if (kind === "sphere") return new THREE.SphereGeometry(size[0], 24, 16);
  if (kind === "ellipsoid") return new THREE.SphereGeometry(1, 24, 16).scale(...size);
  if (kind === "cylinder") return new THREE.CylinderGeometry(size[0], size[0], 2 * size[1], 32).rotateX(Math.PI / 2);
  if (kind === "capsule") return new THREE.CapsuleGeometry(size[0], 2 * size[1], 6, 12).rotateX(Math.PI / 2);
  if (kind === "plane") return new THREE.PlaneGeometry(2 * size[0], 2 * size[1]);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(vertices.flat(), 3));
  geometry.setIndex(faces.flat());
  geometry.computeVertexNormals();
  return geometry;
}

// The floor's tiles, half a meter each, as in the file.
function tiles(half) {
  const canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
  canvas.width = canvas.height = 2;
  pen.fillStyle = "#575c66";
  pen.fillRect(0, 0, 2, 2);
  pen.fillStyle = "#757a85";
  pen.fillRect(0, 0, 1, 1);
  pen.fillRect(1, 1, 1, 1);
  const texture = new THREE.CanvasTexture(canvas);
  texture.magFilter = THREE.NearestFilter;
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.repeat.set(2 * half, 2 * half);
  return texture;
}

// The lab's axes from the bearing, with their names.
export function axes(length) {
  const group = new THREE.Group();
  for (const [name, color, toward] of AXES) {
    const end = new THREE.Vector3(...toward).multiplyScalar(length), material = new THREE.LineBasicMaterial({ color });
    group.add(new THREE.Line(new THREE.BufferGeometry().setFromPoints([new THREE.Vector3(), end]), material));
    const tag = letter(name, color);
    tag.position.copy(end.multiplyScalar(1.06));
    tag.scale.setScalar(0.14 * length);
    group.add(tag);
  }
  return group;
}

// A line between two points, drawn over everything; its points are set later.
export function band() {
  const material = new THREE.LineBasicMaterial({ color: 0xffe27a, depthTest: false });
  const line = new THREE.Line(new THREE.BufferGeometry().setFromPoints([new THREE.Vector3(), new THREE.Vector3()]), material);
  line.frustumCulled = line.visible = false;
  return line;
}

function letter(text, color) {
  const canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
  canvas.width = canvas.height = 64;
  pen.font = "bold 48px ui-monospace, monospace";
  pen.textAlign = "center";
  pen.fillStyle = `#${color.toString(16).padStart(6, "0")}`;
  pen.fillText(text, 32, 48);
  return new THREE.Sprite(new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas), depthTest: false }));
}
