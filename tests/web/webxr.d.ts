// The part of WebXR that the page uses, which the type checker's own library lacks.

interface XRRigidTransform {
  readonly position: { x: number; y: number; z: number };
  readonly orientation: { x: number; y: number; z: number; w: number };
  readonly matrix: Float32Array;
  readonly inverse: XRRigidTransform;
}
declare const XRRigidTransform: {
  new (position: object, orientation: object): XRRigidTransform;
};
type XRSessionMode = "immersive-ar" | "immersive-vr";
interface XRSpace extends EventTarget {}
interface XRReferenceSpace extends XRSpace {
  onreset: (() => void) | null;
  getOffsetReferenceSpace(origin: XRRigidTransform): XRReferenceSpace;
}
interface XRInputSource {
  readonly handedness: string;
  readonly targetRayMode: string;
  readonly targetRaySpace: XRSpace;
  readonly gripSpace?: XRSpace;
  readonly gamepad?: Gamepad;
  readonly hand?: object;
}
interface XRView {
  readonly projectionMatrix: Float32Array;
  readonly transform: XRRigidTransform;
}
interface XRPose {
  readonly transform: XRRigidTransform;
  readonly emulatedPosition: boolean;
}
interface XRViewerPose extends XRPose {
  readonly views: readonly XRView[];
}
interface XRFrame {
  readonly session: XRSession;
  getPose(space: XRSpace, base: XRSpace): XRPose | undefined;
  getViewerPose(space: XRReferenceSpace): XRViewerPose | undefined;
}
type XRFrameRequestCallback = (time: number, frame: XRFrame) => void;
interface XRViewport {
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
}
interface XRWebGLLayer {
  readonly framebuffer: WebGLFramebuffer | null;
  getViewport(view: XRView): XRViewport | undefined;
}
declare const XRWebGLLayer: {
  new (session: XRSession, context: WebGL2RenderingContext): XRWebGLLayer;
};
interface XRSession extends EventTarget {
  readonly inputSources: Iterable<XRInputSource>;
  readonly renderState: { readonly baseLayer?: XRWebGLLayer };
  readonly visibilityState: string;
  onend: (() => void) | null;
  onvisibilitychange: (() => void) | null;
  end(): Promise<void>;
  requestAnimationFrame(callback: XRFrameRequestCallback): number;
  requestReferenceSpace(kind: string): Promise<XRReferenceSpace>;
  updateRenderState(state: { baseLayer: XRWebGLLayer }): void;
}
interface XRSystem {
  isSessionSupported(mode: XRSessionMode): Promise<boolean>;
  requestSession(mode: XRSessionMode, wanted: object): Promise<XRSession>;
}
interface Navigator {
  readonly xr?: XRSystem;
}
interface WebGL2RenderingContext {
  makeXRCompatible(): Promise<void>;
}
