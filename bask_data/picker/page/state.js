"use strict";

// State of the page. A frame is [recording, camera, number]; (u, v) is a position in pixels of its image, with integer
// pixel centres. All other lengths are CSS pixels.

const TOKEN = new URLSearchParams(location.search).get("token") || "";
const N_OTHERS = 8; // most views beside the main one; each adds some 5 ms to the response to the pointer

const state = { marks: [], can_undo: false, can_redo: false, is_saved: false, recordings: [] };
const views = [];
let chosen = ""; // name of the selected keypoint
let hovered = null; // {view, u, v}: pixel under the pointer, or under the keyboard's cross
let dragged = null; // {name, view, u, v, x, y, hasMoved}: a press that has not been released

const $ = (id) => document.getElementById(id);
const blank = () => document.createElement("canvas");
const between = (value, low, high) => Math.max(low, Math.min(value, high));
const clamp = (value, size) => between(value, 0, size - 1);

const same = (a, b) => a[0] === b[0] && a[1] === b[1] && a[2] === b[2];
const key = (frame) => frame.join("\n");
const frameOf = (mark) => [mark.recording, mark.camera, mark.frame];
const recordingOf = (frame) => state.recordings.find((recording) => recording.name === frame[0]);
const camerasOf = (frame) => recordingOf(frame).cameras;
const cameraOf = (frame) => camerasOf(frame).find((camera) => camera.name === frame[1]) || camerasOf(frame)[0];
const markOf = (name) => state.marks.find((mark) => mark.name === name);
const shownViews = () => views.filter((view) => view.isShown && view.frame);
