"""IFC files of known bodies, in millimetres, made by IfcOpenShell's own functions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import ifcopenshell.api.aggregate
import ifcopenshell.api.context
import ifcopenshell.api.feature
import ifcopenshell.api.geometry
import ifcopenshell.api.project
import ifcopenshell.api.root
import ifcopenshell.api.spatial
import ifcopenshell.api.unit
import numpy as np
from ifcopenshell import entity_instance

api = ifcopenshell.api


class Building:
    """A project with a site, a building and a storey at 3 m."""

    def __init__(self, version: str = "IFC4") -> None:
        self.model = api.project.create_file(version=version)
        project = self.entity("IfcProject", "project")
        api.unit.assign_unit(self.model)
        model = api.context.add_context(self.model, context_type="Model")
        self._body = api.context.add_context(
            self.model, context_type="Model", context_identifier="Body", target_view="MODEL_VIEW",
            parent=model,
        )  # fmt: skip
        above = project
        for kind, name in (("Site", "site"), ("Building", "house"), ("BuildingStorey", "ground")):
            below = self.entity(f"Ifc{kind}", name)
            api.aggregate.assign_object(self.model, products=[below], relating_object=above)
            api.geometry.edit_object_placement(self.model, product=below)
            above = below
        self.storey = above
        self._moved(above, (0.0, 0.0, 3.0))

    def entity(self, kind: str, name: str | None) -> entity_instance:
        return api.root.create_entity(self.model, ifc_class=kind, name=name)

    def make(self, kind: str, **said: object) -> entity_instance:
        """An entity that is no product, of attributes by their names."""
        return self.model.create_entity(kind, **said)

    def point(self, *at: float) -> entity_instance:
        return self.make("IfcCartesianPoint", Coordinates=[float(x) for x in at])

    def flat_axes(self) -> entity_instance:
        return self.make("IfcAxis2Placement2D", Location=self.point(0, 0))

    def axes(self) -> entity_instance:
        return self.make("IfcAxis2Placement3D", Location=self.point(0, 0, 0))

    def box(self, *size: float) -> entity_instance:
        """Edges along x, y and z; the middle of the base at the origin."""
        area = self.make(
            "IfcRectangleProfileDef", ProfileType="AREA", Position=self.flat_axes(), XDim=size[0],
            YDim=size[1],
        )  # fmt: skip
        return self._raised(area, size[2])

    def cylinder(self, radius: float, height: float) -> entity_instance:
        area = self.make("IfcCircleProfileDef", ProfileType="AREA", Radius=radius)
        return self._raised(area, height)

    def sphere(self, radius: float) -> entity_instance:
        ball = self.make("IfcSphere", Position=self.axes(), Radius=radius)
        return self.make("IfcCsgSolid", TreeRootExpression=ball)

    def sheet(self) -> entity_instance:
        """A triangle that is one: an open surface."""
        corners = self.make(
            "IfcCartesianPointList3D", CoordList=[[0.0, 0.0, 0.0], [1e3, 0.0, 0.0], [0.0, 1e3, 0.0]]
        )
        return self.make("IfcTriangulatedFaceSet", Coordinates=corners, CoordIndex=[[1, 2, 3]])

    def _raised(self, area: entity_instance, height: float) -> entity_instance:
        up = self.make("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        return self.make(
            "IfcExtrudedAreaSolid", SweptArea=area, Position=self.axes(), ExtrudedDirection=up,
            Depth=height,
        )  # fmt: skip

    def shape(self, item: entity_instance, kind: str = "SweptSolid") -> entity_instance:
        return self.make(
            "IfcShapeRepresentation", ContextOfItems=self._body, RepresentationIdentifier="Body",
            RepresentationType=kind, Items=[item],
        )  # fmt: skip

    def add(
        self, kind: str, name: str | None, shape: entity_instance, at: Sequence[float] = (0, 0, 0)
    ) -> entity_instance:
        """A product on the storey; at : metres."""
        product = self.entity(kind, name)
        api.geometry.assign_representation(self.model, product=product, representation=shape)
        self._moved(product, at)
        if kind != "IfcSpace":
            api.spatial.assign_container(
                self.model, products=[product], relating_structure=self.storey
            )
        return product

    def opening(self, wall: entity_instance, shape: entity_instance) -> Self:
        hole = self.entity("IfcOpeningElement", "hole")
        api.geometry.assign_representation(self.model, product=hole, representation=shape)
        self._moved(hole, (0.0, 0.0, 3.0))
        api.feature.add_feature(self.model, feature=hole, element=wall)
        return self

    def _moved(self, product: entity_instance, at: Sequence[float]) -> None:
        matrix = np.eye(4)
        matrix[:3, 3] = at
        api.geometry.edit_object_placement(self.model, product=product, matrix=matrix)

    def written(self, path: Path) -> Path:
        self.model.write(path)
        return path
