// Runs after the page of trimesh, and uses its variables camera, controls, scene, renderer and its function render.
function lookFrom(place, forward, up, field) {
  const distance = Math.max(0.1, -(place[0] * forward[0] + place[1] * forward[1] + place[2] * forward[2]));
  camera.fov = field;
  camera.up.set(...up);
  camera.position.set(...place);
  controls.target.set(...place.map((value, axis) => value + distance * forward[axis]));
  camera.lookAt(controls.target);
  camera.updateProjectionMatrix();
  controls.update();
  render();
}

// The field of view covers the whole image, whatever the shape of the window.
function lookAsView(view) {
  const pose = settings.poses[view];
  const [high, wide] = pose.slice(9);
  const field = 2 * Math.atan(Math.max(high, wide / camera.aspect)) * 180 / Math.PI;
  lookFrom(pose.slice(0, 3), pose.slice(3, 6), pose.slice(6, 9), Math.min(110, 1.05 * field));
}

function lookAtStart() {
  lookAsView(settings.first);
}

function shade(shaded) {
  scene.traverse((part) => {
    if (!part.isMesh) return;
    const material = shaded ? THREE.MeshLambertMaterial : THREE.MeshBasicMaterial;
    part.material = new material({ vertexColors: true, side: THREE.DoubleSide });
  });
  render();
}

function addTools() {
  const tools = document.createElement("div");
  tools.id = "tools";
  const addBox = (name, checked, change) => {
    const label = document.createElement("label");
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = checked;
    box.onchange = () => change(box.checked);
    label.append(box, " " + name);
    tools.append(label);
    change(checked);
  };
  const hasMesh = scene.getObjectByName("mesh") !== undefined;
  for (const name of ["mesh", "points", "cameras"]) {
    const part = scene.getObjectByName(name);
    if (part === undefined) continue;
    // Points are on the mesh, and would hide it.
    addBox(name, name !== "points" || !hasMesh, (shown) => { part.visible = shown; render(); });
  }
  if (hasMesh) addBox("shading", settings.shaded, shade);
  const button = document.createElement("button");
  button.textContent = "start view";
  button.onclick = lookAtStart;
  tools.append(button);
  document.body.append(tools);
}

function begin() {
  if (camera === undefined || controls === undefined) {
    requestAnimationFrame(begin);
    return;
  }
  camera.near = 0.005;
  camera.far = 10000;
  controls.rotateSpeed = 2.5;
  scene.add(new THREE.AmbientLight(0xffffff, 0.35));
  tracklight.intensity = 0.75;
  scene.traverse((part) => {
    if (part.isPoints) part.material = new THREE.PointsMaterial({ size: 2.5, sizeAttenuation: false, vertexColors: true });
  });
  addTools();
  lookAtStart();
  document.body.dataset.ready = "yes";
}

begin();
