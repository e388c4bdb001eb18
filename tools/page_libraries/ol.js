// The parts of OpenLayers that the page uses, by the names of its full build.
import Feature from "ol/Feature.js";
import Map from "ol/Map.js";
import View from "ol/View.js";
import FullScreen from "ol/control/FullScreen.js";
import ScaleLine from "ol/control/ScaleLine.js";
import {defaults as controls} from "ol/control/defaults.js";
import {altKeyOnly, always, platformModifierKeyOnly, primaryAction, shiftKeyOnly} from "ol/events/condition.js";
import {boundingExtent, buffer, containsCoordinate, createEmpty, extend, getCenter, isEmpty} from "ol/extent.js";
import Circle from "ol/geom/Circle.js";
import LineString from "ol/geom/LineString.js";
import MultiLineString from "ol/geom/MultiLineString.js";
import MultiPoint from "ol/geom/MultiPoint.js";
import MultiPolygon from "ol/geom/MultiPolygon.js";
import Point from "ol/geom/Point.js";
import Polygon from "ol/geom/Polygon.js";
import DragPan from "ol/interaction/DragPan.js";
import DragRotate from "ol/interaction/DragRotate.js";
import Draw from "ol/interaction/Draw.js";
import Modify from "ol/interaction/Modify.js";
import Snap from "ol/interaction/Snap.js";
import {defaults as interactions} from "ol/interaction/defaults.js";
import Layer from "ol/layer/Layer.js";
import VectorLayer from "ol/layer/Vector.js";
import {unByKey} from "ol/Observable.js";
import Projection from "ol/proj/Projection.js";
import VectorSource from "ol/source/Vector.js";
import CircleStyle from "ol/style/Circle.js";
import Fill from "ol/style/Fill.js";
import RegularShape from "ol/style/RegularShape.js";
import Stroke from "ol/style/Stroke.js";
import Style from "ol/style/Style.js";
import Text from "ol/style/Text.js";

globalThis.ol = {
  Feature, Map, View,
  Observable: {unByKey},
  control: {FullScreen, ScaleLine, defaults: controls},
  events: {condition: {altKeyOnly, always, platformModifierKeyOnly, primaryAction, shiftKeyOnly}},
  extent: {boundingExtent, buffer, containsCoordinate, createEmpty, extend, getCenter, isEmpty},
  geom: {Circle, LineString, MultiLineString, MultiPoint, MultiPolygon, Point, Polygon},
  interaction: {DragPan, DragRotate, Draw, Modify, Snap, defaults: interactions},
  layer: {Layer, Vector: VectorLayer},
  proj: {Projection},
  source: {Vector: VectorSource},
  style: {Circle: CircleStyle, Fill, RegularShape, Stroke, Style, Text},
};
