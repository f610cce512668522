{{/* The robot and the scene that a user brings as ConfigMaps, and the experiment with them and with ROS. */}}

{{/* Path of the user's "robot" or "scene" in the pods; "" if the user brings none.
     Argument: (dict "root" $ "kind" KIND). */}}
{{- define "cloudrc.ownPath" -}}
{{- with (index .root.Values .kind).configMap -}}
/etc/cloudrc-{{ $.kind }}/{{ . }}{{ eq $.kind "scene" | ternary "/scene.xml" "" }}
{{- end -}}
{{- end }}

{{/* Content of the user's ConfigMaps, "" where it is unknown. If the cluster can be asked, a ConfigMap
     that is missing or lacks its main file fails here, not when the pods start. */}}
{{- define "cloudrc.ownFiles" -}}
{{- range $kind, $file := dict "robot" "robot.yaml" "scene" "scene.xml" -}}
{{- $name := (index $.Values $kind).configMap -}}
{{- if and $name (lookup "v1" "Namespace" "" $.Release.Namespace) -}}
{{- $found := lookup "v1" "ConfigMap" $.Release.Namespace $name | default dict -}}
{{- $files := merge dict ($found.data | default dict) ($found.binaryData | default dict) -}}
{{- if not (hasKey $files $file) -}}
{{- $from := eq $kind "robot" | ternary "FOLDER" "scene.xml=FILE" -}}
{{- $problem := empty $found | ternary (printf "no ConfigMap '%s' in namespace '%s'" $name $.Release.Namespace) (printf "ConfigMap '%s' has no %s" $name $file) -}}
{{- fail (printf "%s.configMap: %s; make it: kubectl -n %s create configmap %s --from-file=%s" $kind $problem $.Release.Namespace $name $from) -}}
{{- end -}}
{{ toYaml $files }}
{{- end -}}
{{- end -}}
{{- end }}

{{/* Name of the controller in the values' `experiment`; "" if it names none. */}}
{{- define "cloudrc.controllerName" -}}
{{- $controller := (.Values.experiment.cloud | default dict).controller | default "" -}}
{{ kindIs "map" $controller | ternary (get (kindIs "map" $controller | ternary $controller dict) "name") $controller }}
{{- end }}

{{/* Whether the robot's camera works: "true" or "". */}}
{{- define "cloudrc.hasCamera" -}}
{{- if not (kindIs "invalid" .Values.experiment.camera) }}true{{ end -}}
{{- end }}

{{/* The values' `experiment` with the user's robot and scene, and with the controller of cloud.ros, in
     the format of `cloudrc run`. That of a fleet lacks the number of robots, which may change without
     restarts, and has the link of link.profile, because a cell follows no other file. */}}
{{- define "cloudrc.experiment" -}}
{{- $experiment := deepCopy .Values.experiment -}}
{{- $_ := include "cloudrc.takeRetired" (dict "root" . "values" (dict "experiment" $experiment)) -}}
{{- if and .Values.cloud.ros.enabled (not (include "cloudrc.controllerName" .)) -}}
{{- $_ := set $experiment "cloud" (set ($experiment.cloud | default dict) "controller" "ros2") -}}
{{- end -}}
{{- $world := $experiment.world | default dict -}}
{{- range $kind := list "robot" "scene" -}}
{{- with include "cloudrc.ownPath" (dict "root" $ "kind" $kind) -}}
{{- $_ := set $world $kind . -}}
{{- $_ := set $experiment "world" $world -}}
{{- end -}}
{{- end -}}
{{- if include "cloudrc.isFleet" . -}}
{{- $_ := set $experiment "fleet" (omit ($experiment.fleet | default dict) "robots") -}}
{{- with .Values.link.profile -}}
{{- $_ := set $experiment "link" (kindIs "map" . | ternary . (dict "profile" .)) -}}
{{- end -}}
{{- end -}}
{{ toYaml $experiment }}
{{- end }}

{{/* Volumes and mounts of every container that reads the experiment. */}}
{{- define "cloudrc.experimentVolumes" -}}
- name: experiment
  configMap:
    name: {{ include "cloudrc.fullname" . }}-experiment
{{- range $kind := list "robot" "scene" }}
{{- with (index $.Values $kind).configMap }}
- name: {{ $kind }}
  configMap:
    name: {{ . }}
{{- end }}
{{- end }}
{{- end }}

{{- define "cloudrc.experimentMounts" -}}
- {name: experiment, mountPath: /etc/cloudrc, readOnly: true}
{{- range $kind := list "robot" "scene" }}
{{- with (index $.Values $kind).configMap }}
- {name: {{ $kind }}, mountPath: /etc/cloudrc-{{ $kind }}/{{ . }}, readOnly: true}
{{- end }}
{{- end }}
{{- end }}
