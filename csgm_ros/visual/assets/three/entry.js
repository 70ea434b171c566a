// What the report needs of three.js; `build.sh` bundles it into three.min.js.
export {
  BufferAttribute,
  BufferGeometry,
  Color,
  LineBasicMaterial,
  LineSegments,
  Matrix4,
  PerspectiveCamera,
  Points,
  Quaternion,
  Scene,
  ShaderMaterial,
  Vector3,
  WebGLRenderer,
} from 'three';
export { TrackballControls } from 'three/addons/controls/TrackballControls.js';
